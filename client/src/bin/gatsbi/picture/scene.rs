//! One step as a scene to paint, what its masks cut out of the frame, and a recording's labels.

use gatsbi_client::{Array, Object};
use gatsbi_episodes::LabelLegend;
use gatsbi_pictures::{
    palette::{AGENT, colours},
    scene::{self, DARK, PRESENT, Scene, mix},
};
use image::{Rgb, RgbImage};

const EMPTY: Rgb<u8> = Rgb([235; 3]);

/// What a mask cuts out of a frame.
pub(crate) fn cut_out(frame: &RgbImage, mask: &[f32]) -> RgbImage {
    let pixels: Vec<Rgb<u8>> = frame.pixels().copied().collect();
    paint(frame.dimensions(), |at| mix(EMPTY, pixels[at], mask[at]))
}

/// A recording's labels in the colours of agent and objects.
pub(crate) fn labelled(size: (u32, u32), labels: &[u8], legend: LabelLegend) -> RgbImage {
    let id = |label: u8| label.checked_sub(legend.first_object).map(u64::from);
    let colours = colours(labels.iter().filter_map(|label| id(*label)));
    paint(size, |at| match labels[at] {
        label if label == legend.agent => AGENT,
        label => id(label).map_or(DARK, |id| colours[&id]),
    })
}

/// A step over a frame of the masks' size; of the objects those that are there more surely than not.
pub(crate) fn scene(
    picture: RgbImage,
    agent: Option<&Array>,
    masks: &Array,
    objects: &[Object],
) -> Scene {
    let there = objects.iter().filter(|object| object.presence > PRESENT);
    let objects = there.map(|object| {
        let Object { id, presence, x, y, width, height, .. } = *object;
        let painted = scene::Object { id, presence, x, y, width, height };
        (painted, masks.at(&[object.slot as usize]).to_f32())
    });
    Scene { picture, agent: agent.map(Array::to_f32), objects: objects.collect() }
}

fn paint((width, height): (u32, u32), colour: impl Fn(usize) -> Rgb<u8>) -> RgbImage {
    RgbImage::from_fn(width, height, |x, y| colour((y * width + x) as usize))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mask_cuts_out_what_it_covers() {
        let frame = RgbImage::from_pixel(2, 1, Rgb([100; 3]));
        let agent = cut_out(&frame, &[1.0, 0.0]);
        assert_eq!((agent.get_pixel(0, 0), agent.get_pixel(1, 0)), (&Rgb([100; 3]), &EMPTY));
    }

    #[test]
    fn labels_have_the_colours_of_what_they_name() {
        let legend = LabelLegend { background: 0, agent: 1, first_object: 2 };
        let picture = labelled((4, 1), &[0, 1, 2, 4], legend);
        let painted: Vec<_> = picture.pixels().copied().collect();
        let objects = colours([0, 2]);
        assert_eq!(painted, [DARK, AGENT, objects[&0], objects[&2]]);
    }
}
