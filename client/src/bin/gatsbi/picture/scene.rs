//! One step painted: its masks, what they cut out of the frame, and all of it over the frame.

use std::collections::BTreeMap;

use embedded_graphics::mono_font::ascii::FONT_6X10;
use gatsbi_client::{Array, Object};
use gatsbi_episodes::LabelLegend;
use image::{Rgb, RgbImage};

use super::{
    canvas::Canvas,
    enlarge,
    palette::{AGENT, colours},
};

/// How strongly masks tint.
const TINT: f32 = 0.5;
const DARK: Rgb<u8> = Rgb([20; 3]);
const EMPTY: Rgb<u8> = Rgb([235; 3]);

/// A decomposed step. Masks are shares in [0, 1] of the image's pixels, row by row.
#[derive(Clone, Debug)]
pub(crate) struct Scene {
    /// What the masks belong to: the camera's frame, or the model's own.
    pub(crate) frame: RgbImage,
    /// The agent's mask.
    pub(crate) agent: Option<Vec<f32>>,
    /// Objects that are there, each with its mask.
    pub(crate) objects: Vec<(Object, Vec<f32>)>,
}

/// A mask in grey: white is 1.
pub(crate) fn grey(size: (u32, u32), mask: &[f32]) -> RgbImage {
    paint(size, |at| Rgb([(mask[at] * 255.0).round() as u8; 3]))
}

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

impl Scene {
    /// A step over a frame of the masks' size; of the objects those that are there more surely than not.
    pub(crate) fn new(
        frame: RgbImage,
        agent: Option<&Array>,
        masks: &Array,
        objects: &[Object],
    ) -> Self {
        let there = objects.iter().filter(|object| object.presence > 0.5);
        let objects =
            there.map(|object| (*object, masks.at(&[object.slot as usize]).to_f32())).collect();
        Self { frame, agent: agent.map(Array::to_f32), objects }
    }

    /// Objects in their colours on a dark ground.
    pub(crate) fn objects(&self) -> RgbImage {
        let dark = RgbImage::from_pixel(self.frame.width(), self.frame.height(), DARK);
        self.tinted(dark, 1.0, false)
    }

    /// The frame with tinted masks, and around each object its box and identity.
    pub(crate) fn overlay(&self, times: u32) -> RgbImage {
        let tinted = self.tinted(self.frame.clone(), TINT, true);
        self.boxed(&tinted, times)
    }

    /// A picture of the same step, enlarged, with a box and the identity around each object.
    pub(crate) fn boxed(&self, picture: &RgbImage, times: u32) -> RgbImage {
        let (width, height) = picture.dimensions();
        let mut canvas = Canvas(enlarge(picture, times));
        let colours = self.colours();
        for (object, _) in &self.objects {
            let colour = colours[&object.id];
            let side = |share: f32, pixels: u32| (share * (pixels * times) as f32).round();
            let (w, h) = (side(object.width, width), side(object.height, height));
            let middle = |x: f32, pixels: u32| f32::midpoint(x, 1.0) * (pixels * times) as f32;
            let left = (middle(object.x, width) - w / 2.0).round() as i32;
            let top = (middle(object.y, height) - h / 2.0).round() as i32;
            canvas.outline((left, top), (w as u32, h as u32), colour);
            let label = object.id.to_string();
            // Above the box, or inside it at the upper edge.
            canvas.text((left, (top - 10).max(0)), &label, &FONT_6X10, DARK, Some(colour));
        }
        canvas.0
    }

    fn colours(&self) -> BTreeMap<u64, Rgb<u8>> {
        colours(self.objects.iter().map(|(object, _)| object.id))
    }

    fn tinted(&self, ground: RgbImage, strength: f32, with_agent: bool) -> RgbImage {
        let mut picture = ground;
        let agent = self.agent.iter().filter(|_| with_agent).map(|mask| (AGENT, mask));
        let colours = self.colours();
        let objects = self.objects.iter().map(|(object, mask)| (colours[&object.id], mask));
        for (colour, mask) in agent.chain(objects) {
            for (pixel, share) in picture.pixels_mut().zip(mask) {
                *pixel = mix(*pixel, colour, share * strength);
            }
        }
        picture
    }
}

fn paint((width, height): (u32, u32), colour: impl Fn(usize) -> Rgb<u8>) -> RgbImage {
    RgbImage::from_fn(width, height, |x, y| colour((y * width + x) as usize))
}

fn mix(from: Rgb<u8>, to: Rgb<u8>, share: f32) -> Rgb<u8> {
    let channel = |i: usize| {
        let (from, to) = (f32::from(from[i]), f32::from(to[i]));
        (from + (to - from) * share.clamp(0.0, 1.0)).round() as u8
    };
    Rgb([channel(0), channel(1), channel(2)])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene() -> Scene {
        let object = Object {
            id: 1,
            presence: 1.0,
            x: 0.5,
            y: -0.5,
            width: 0.5,
            height: 0.5,
            ..Object::default()
        };
        let mut mask = vec![0.0; 16 * 16];
        mask[4 * 16 + 12] = 1.0;
        let mut agent = vec![0.0; 16 * 16];
        agent[0] = 1.0;
        let frame = RgbImage::from_pixel(16, 16, Rgb([100; 3]));
        Scene { frame, agent: Some(agent), objects: vec![(object, mask)] }
    }

    #[test]
    fn masks_tint_what_they_cover() {
        let scene = scene();
        let objects = scene.objects();
        assert_eq!(objects.get_pixel(12, 4), &scene.colours()[&1]);
        assert_eq!((objects.get_pixel(0, 0), objects.get_pixel(12, 5)), (&DARK, &DARK));
        let overlay = scene.overlay(1);
        assert_eq!(overlay.get_pixel(0, 0), &mix(Rgb([100; 3]), AGENT, TINT));
        assert_eq!(overlay.get_pixel(1, 15), &Rgb([100; 3]));
        let agent = cut_out(&scene.frame, scene.agent.as_ref().unwrap());
        assert_eq!((agent.get_pixel(0, 0), agent.get_pixel(1, 0)), (&Rgb([100; 3]), &EMPTY));
        let grey = grey((16, 16), scene.agent.as_ref().unwrap());
        assert_eq!((grey.get_pixel(0, 0), grey.get_pixel(1, 0)), (&Rgb([255; 3]), &Rgb([0; 3])));
    }

    #[test]
    fn labels_have_the_colours_of_what_they_name() {
        let legend = LabelLegend { background: 0, agent: 1, first_object: 2 };
        let picture = labelled((4, 1), &[0, 1, 2, 4], legend);
        let colours: Vec<_> = picture.pixels().copied().collect();
        let objects = super::colours([0, 2]);
        assert_eq!(colours, [DARK, AGENT, objects[&0], objects[&2]]);
    }

    #[test]
    fn boxes_lie_where_the_objects_are() {
        let overlay = scene().overlay(3);
        assert_eq!(overlay.dimensions(), (48, 48));
        // Centre (36, 12), 24 pixels wide and high.
        assert_eq!(overlay.get_pixel(24, 23), &scene().colours()[&1]);
        assert_eq!(overlay.get_pixel(47, 23), &scene().colours()[&1]);
        assert_ne!(overlay.get_pixel(30, 18), &scene().colours()[&1]);
    }

    #[test]
    fn an_object_outside_the_image_does_no_harm() {
        let mut scene = scene();
        (scene.objects[0].0.x, scene.objects[0].0.y) = (-3.0, 9.0);
        scene.objects[0].0.width = f32::NAN;
        assert_eq!(scene.overlay(2).dimensions(), (32, 32));
    }
}
