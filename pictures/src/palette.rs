//! Colours of the agent and of objects, which the page has too.
//!
//! The rule: of the objects in one picture, from the lowest id to the highest, each takes the colour at its id modulo
//! the palette's size, or the next one that is free; when all are taken, all are free again. So objects that are seen
//! together have different colours as far as the palette goes, and one that others come and go beside mostly keeps its
//! own.
//!
//! The colours were searched for the greatest distance between any two, the agent's among them, for people who see all
//! colours and for those who see no difference between red and green or between blue and yellow. All are light enough
//! for dark letters.

use std::collections::{BTreeMap, BTreeSet};

use image::Rgb;

/// The colour of the agent.
pub const AGENT: Rgb<u8> = Rgb([34, 74, 250]);

/// Colours of objects.
const OBJECTS: [Rgb<u8>; 8] = [
    Rgb([255, 151, 3]),
    Rgb([103, 254, 199]),
    Rgb([236, 34, 170]),
    Rgb([248, 233, 25]),
    Rgb([107, 138, 252]),
    Rgb([180, 116, 30]),
    Rgb([250, 163, 255]),
    Rgb([158, 183, 157]),
];

/// The colours of the objects in one picture.
pub fn colours(ids: impl IntoIterator<Item = u64>) -> BTreeMap<u64, Rgb<u8>> {
    let mut free = [true; OBJECTS.len()];
    let coloured = ids.into_iter().collect::<BTreeSet<u64>>().into_iter().map(|id| {
        if !free.contains(&true) {
            free = [true; OBJECTS.len()];
        }
        let own = (id % OBJECTS.len() as u64) as usize;
        let next = (own..OBJECTS.len()).chain(0..own).find(|at| free[*at]).unwrap_or(own);
        free[next] = false;
        (id, OBJECTS[next])
    });
    coloured.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    type Matrix = [[f64; 3]; 3];

    /// What people see who lack one kind of cone (Machado, Oliveira and Fernandes 2009, severity 1), in linear light.
    const LACKING: [(&str, Matrix); 3] = [
        (
            "red",
            [
                [0.152_286, 1.052_583, -0.204_868],
                [0.114_503, 0.786_281, 0.099_216],
                [-0.003_882, -0.048_116, 1.051_998],
            ],
        ),
        (
            "green",
            [
                [0.367_322, 0.860_646, -0.227_968],
                [0.280_085, 0.672_501, 0.047_413],
                [-0.011_820, 0.042_940, 0.968_881],
            ],
        ),
        (
            "blue",
            [
                [1.255_528, -0.076_749, -0.178_779],
                [-0.078_411, 0.930_809, 0.147_602],
                [0.004_733, 0.691_367, 0.303_900],
            ],
        ),
    ];
    /// Oklab (Ottosson 2020): a difference of 0.02 can just be seen.
    const TO_CONES: Matrix = [
        [0.412_221_470_8, 0.536_332_536_3, 0.051_445_992_9],
        [0.211_903_498_2, 0.680_699_545_1, 0.107_396_956_6],
        [0.088_302_461_9, 0.281_718_837_6, 0.629_978_700_5],
    ];
    const TO_OKLAB: Matrix = [
        [0.210_454_255_3, 0.793_617_785_0, -0.004_072_046_8],
        [1.977_998_495_1, -2.428_592_205_0, 0.450_593_709_9],
        [0.025_904_037_1, 0.782_771_766_2, -0.808_675_766_0],
    ];

    fn times(matrix: Matrix, x: [f64; 3]) -> [f64; 3] {
        matrix.map(|row| row.iter().zip(x).map(|(a, b)| a * b).sum())
    }

    fn linear(Rgb(bytes): Rgb<u8>) -> [f64; 3] {
        bytes.map(|byte| {
            let share = f64::from(byte) / 255.0;
            if share <= 0.040_45 { share / 12.92 } else { ((share + 0.055) / 1.055).powf(2.4) }
        })
    }

    fn oklab(light: [f64; 3]) -> [f64; 3] {
        times(TO_OKLAB, times(TO_CONES, light.map(|part| part.clamp(0.0, 1.0))).map(f64::cbrt))
    }

    fn nearest(see: impl Fn([f64; 3]) -> [f64; 3]) -> f64 {
        let all: Vec<[f64; 3]> =
            OBJECTS.iter().chain([&AGENT]).map(|colour| oklab(see(linear(*colour)))).collect();
        let distance = |a: [f64; 3], b: [f64; 3]| {
            a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
        };
        let pairs = (0..all.len()).flat_map(|a| (0..a).map(move |b| (a, b)));
        pairs.map(|(a, b)| distance(all[a], all[b])).fold(f64::INFINITY, f64::min)
    }

    #[test]
    fn any_two_colours_differ_for_everybody() {
        let told = nearest(|light| light);
        assert!(told > 0.16, "{told}");
        for (cone, matrix) in LACKING {
            let told = nearest(|light| times(matrix, light));
            assert!(told > 0.1, "without the {cone} cone: {told}");
        }
    }

    #[test]
    fn dark_letters_can_be_read_on_all() {
        let luminance = |colour: Rgb<u8>| {
            let light = linear(colour);
            0.2126 * light[0] + 0.7152 * light[1] + 0.0722 * light[2]
        };
        for colour in OBJECTS {
            // WCAG 2.2, 1.4.3.
            let contrast = (luminance(colour) + 0.05) / (luminance(Rgb([22, 24, 27])) + 0.05);
            assert!(contrast >= 4.5, "{colour:?}: {contrast}");
        }
    }

    #[test]
    fn objects_of_a_picture_share_no_colour_while_there_are_enough() {
        let places = |ids: &[u64]| -> Vec<usize> {
            let colours = colours(ids.iter().copied());
            let place = |colour: &Rgb<u8>| OBJECTS.iter().position(|other| other == colour);
            ids.iter().map(|id| place(&colours[id]).unwrap()).collect()
        };
        assert_eq!(places(&[0, 1, 7]), [0, 1, 7]);
        assert_eq!(places(&[11, 3, 19]), [4, 3, 5], "the lowest id chooses first");
        assert_eq!(places(&[7, 15]), [7, 0]);
        assert_eq!(places(&[u64::MAX]), [7]);
        for step in 1..40 {
            let ids: Vec<u64> = (0..8).map(|i| 5 + i * step).collect();
            let taken: BTreeSet<usize> = places(&ids).into_iter().collect();
            assert_eq!(taken.len(), 8, "ids {ids:?}");
        }
        let many: Vec<u64> = (0..20).map(|i| i * 8).collect();
        assert_eq!(places(&many)[..10], [0, 1, 2, 3, 4, 5, 6, 7, 0, 1], "then from the beginning");
    }
}
