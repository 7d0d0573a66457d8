//! One step painted: its masks over the picture, and around each object its box and identity.

use std::collections::BTreeMap;

use image::{Rgb, RgbImage};

use crate::{
    canvas::{Canvas, font::FONT_6X10},
    enlarge,
    palette::{AGENT, colours},
};

/// How surely an object must be there to be painted.
pub const PRESENT: f32 = 0.5;

/// How strongly masks tint.
const TINT: f32 = 0.5;

/// The ground on which nothing is seen.
pub const DARK: Rgb<u8> = Rgb([20; 3]);

/// A decomposed step. Masks are shares in [0, 1] of the picture's pixels, row by row.
#[derive(Clone, Debug)]
pub struct Scene {
    /// What the masks belong to: the camera's picture, or the model's own.
    pub picture: RgbImage,
    /// The agent's mask.
    pub agent: Option<Vec<f32>>,
    /// Objects that are there, each with its mask.
    pub objects: Vec<(Object, Vec<f32>)>,
}

/// An object of a scene; `x` rightwards and `y` downwards in [-1, 1], sizes as shares of the picture.
#[derive(Clone, Copy, Debug, Default)]
pub struct Object {
    /// Identity in its session.
    pub id: u64,
    /// How surely it is there, in [0, 1].
    pub presence: f32,
    /// Centre.
    pub x: f32,
    /// Centre.
    pub y: f32,
    /// Of the box.
    pub width: f32,
    /// Of the box.
    pub height: f32,
}

impl Scene {
    /// The picture with tinted masks, enlarged, with a box and the identity around each object.
    pub fn overlay(&self, times: u32) -> RgbImage {
        let agent = self.agent.iter().map(|mask| (AGENT, mask));
        let tinted = self.tinted(self.picture.clone(), TINT, agent);
        self.boxed(&tinted, times)
    }

    /// Objects in their colours on a dark ground.
    pub fn objects_alone(&self) -> RgbImage {
        let (width, height) = self.picture.dimensions();
        self.tinted(RgbImage::from_pixel(width, height, DARK), 1.0, [])
    }

    /// A picture of the same step, enlarged, with a box and the identity around each object.
    pub fn boxed(&self, picture: &RgbImage, times: u32) -> RgbImage {
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

    /// The ground under the objects' masks, and under others before them.
    fn tinted<'a>(
        &'a self,
        mut ground: RgbImage,
        strength: f32,
        before: impl IntoIterator<Item = (Rgb<u8>, &'a Vec<f32>)>,
    ) -> RgbImage {
        let colours = self.colours();
        let objects = self.objects.iter().map(|(object, mask)| (colours[&object.id], mask));
        for (colour, mask) in before.into_iter().chain(objects) {
            for (pixel, share) in ground.pixels_mut().zip(mask) {
                *pixel = mix(*pixel, colour, share * strength);
            }
        }
        ground
    }
}

/// A mask in grey: white is 1.
pub fn grey((width, height): (u32, u32), mask: &[f32]) -> RgbImage {
    let share = |x, y| (mask[(y * width + x) as usize].clamp(0.0, 1.0) * 255.0).round() as u8;
    RgbImage::from_fn(width, height, |x, y| Rgb([share(x, y); 3]))
}

/// A colour between two; `share` of the second.
pub fn mix(from: Rgb<u8>, to: Rgb<u8>, share: f32) -> Rgb<u8> {
    let channel = |i: usize| {
        let (from, to) = (f32::from(from[i]), f32::from(to[i]));
        (from + (to - from) * share.clamp(0.0, 1.0)).round() as u8
    };
    Rgb([0, 1, 2].map(channel))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene() -> Scene {
        let object = Object { id: 1, presence: 1.0, x: 0.5, y: -0.5, width: 0.5, height: 0.5 };
        let mut mask = vec![0.0; 16 * 16];
        mask[4 * 16 + 12] = 1.0;
        let mut agent = vec![0.0; 16 * 16];
        agent[0] = 1.0;
        let picture = RgbImage::from_pixel(16, 16, Rgb([100; 3]));
        Scene { picture, agent: Some(agent), objects: vec![(object, mask)] }
    }

    #[test]
    fn masks_tint_what_they_cover() {
        let scene = scene();
        let objects = scene.objects_alone();
        assert_eq!(objects.get_pixel(12, 4), &scene.colours()[&1]);
        assert_eq!((objects.get_pixel(0, 0), objects.get_pixel(12, 5)), (&DARK, &DARK));
        let overlay = scene.overlay(1);
        assert_eq!(overlay.get_pixel(0, 0), &mix(Rgb([100; 3]), AGENT, TINT));
        assert_eq!(overlay.get_pixel(1, 15), &Rgb([100; 3]));
        let grey = grey((16, 16), scene.agent.as_ref().unwrap());
        assert_eq!((grey.get_pixel(0, 0), grey.get_pixel(1, 0)), (&Rgb([255; 3]), &Rgb([0; 3])));
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
