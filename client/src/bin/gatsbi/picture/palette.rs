//! Colours of the agent and of objects, the same as in the server's pictures, with the same rule: of the objects in one
//! picture, from the lowest id to the highest, each takes the colour at its id modulo the palette's size, or the next
//! one that is free; when all are taken, all are free again.

use std::collections::{BTreeMap, BTreeSet};

use image::Rgb;

/// The colour of the agent.
pub(crate) const AGENT: Rgb<u8> = Rgb([34, 74, 250]);

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
pub(crate) fn colours(ids: impl IntoIterator<Item = u64>) -> BTreeMap<u64, Rgb<u8>> {
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

    #[test]
    fn objects_of_a_picture_share_no_colour_while_there_are_enough() {
        let places = |ids: &[u64]| -> Vec<usize> {
            let colours = colours(ids.iter().copied());
            let place = |colour: &Rgb<u8>| OBJECTS.iter().position(|other| other == colour);
            ids.iter().map(|id| place(&colours[id]).unwrap()).collect()
        };
        assert_eq!(places(&[11, 3, 19]), [4, 3, 5], "the lowest id chooses first");
        assert_eq!(places(&[7, 15]), [7, 0]);
        let many: Vec<u64> = (0..10).map(|i| i * 8).collect();
        assert_eq!(places(&many), [0, 1, 2, 3, 4, 5, 6, 7, 0, 1], "then from the beginning");
    }
}
