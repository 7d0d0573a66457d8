//! One step painted: as it was seen, as the model has it, its masks, and all of it in one picture.

use std::collections::BTreeMap;

use gatsbi_models::scene::Output;
use gatsbi_proto::v1;
use image::{Rgb, RgbImage};

use super::{
    byte,
    canvas::{Canvas, sheet},
    enlarge,
    palette::{AGENT, colours},
};
use crate::{frame::Frame, sessions::live::Shown};

/// How strongly masks tint.
const TINT: f32 = 0.5;
const DARK: Rgb<u8> = Rgb([20; 3]);
/// Tiles of a row of the sheet of masks.
const COLUMNS: usize = 5;
/// How surely an object must be there to be painted.
pub const PRESENT: f32 = 0.5;

/// Which picture of a step.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum Of {
    /// What was observed, as the model takes it.
    #[default]
    Camera,
    /// What the model makes of it.
    Belief,
}

/// A decomposed step. Masks are shares of the image's pixels times 255, row by row.
#[derive(Clone, Debug)]
pub struct Scene {
    /// The picture that masks belong to.
    pub picture: RgbImage,
    /// The agent's mask.
    pub agent: Option<Vec<u8>>,
    /// Objects that are there, each with its mask.
    pub objects: Vec<(v1::Object, Vec<u8>)>,
}

/// A frame of `[3, size, size]` as a picture.
pub fn camera(frame: &Frame, size: u32) -> RgbImage {
    let colours: Vec<u8> = match frame {
        Frame::Bytes(bytes) => bytes.to_vec(),
        Frame::Floats(floats) => floats.iter().copied().map(byte).collect(),
    };
    let pixels = (size * size) as usize;
    RgbImage::from_fn(size, size, |x, y| {
        let at = (y * size + x) as usize;
        Rgb([0, 1, 2].map(|channel| colours[channel * pixels + at]))
    })
}

/// A step's picture: the camera's where one was asked for and came, or else the model's.
pub fn picture(shown: &Shown, of: Of) -> RgbImage {
    match (&shown.seen.frame, of) {
        (Some(colours), Of::Camera) => camera(colours, shown.image_size),
        _ => belief(shown),
    }
}

/// The model's picture of a step.
fn belief(shown: &Shown) -> RgbImage {
    let colours = shown.floats(Output::Frame).unwrap_or_default();
    let bytes = colours.into_iter().map(byte).collect();
    let size = shown.image_size;
    RgbImage::from_raw(size, size, bytes).unwrap_or_else(|| RgbImage::new(size, size))
}

impl Scene {
    /// A step that is shown.
    pub fn new(shown: &Shown, of: Of) -> Self {
        let bytes = |numbers: Vec<f32>| numbers.into_iter().map(byte).collect::<Vec<u8>>();
        let masks = bytes(shown.floats(Output::ObjectMasks).unwrap_or_default());
        let pixels = (shown.image_size * shown.image_size) as usize;
        let there = shown.objects.iter().filter(|object| object.presence > PRESENT);
        let objects = there.filter_map(|object| {
            let mask = masks.get(object.slot as usize * pixels..)?.get(..pixels)?;
            Some((*object, mask.to_vec()))
        });
        let agent = shown.floats(Output::AgentMask).map(bytes);
        Self { picture: picture(shown, of), agent, objects: objects.collect() }
    }

    /// The picture with tinted masks, and around each object its box and identity.
    pub fn overlay(&self, scale: u32) -> RgbImage {
        let (width, height) = self.picture.dimensions();
        let tinted = self.tinted(self.picture.clone(), TINT, true);
        let mut canvas = Canvas(enlarge(&tinted, scale));
        let colours = self.colours();
        for (object, _) in &self.objects {
            let colour = colours[&object.id];
            let side = |share: f32, pixels: u32| (share * (pixels * scale) as f32).round();
            let (w, h) = (side(object.width, width), side(object.height, height));
            let middle = |x: f32, pixels: u32| f32::midpoint(x, 1.0) * (pixels * scale) as f32;
            let left = (middle(object.x, width) - w / 2.0).round() as i32;
            let top = (middle(object.y, height) - h / 2.0).round() as i32;
            canvas.outline((left, top), (w as u32, h as u32), colour);
            // Above the box, or inside it at the upper edge.
            let label = object.id.to_string();
            canvas.text((left, (top - 10).max(0)), &label, DARK, Some(colour));
        }
        canvas.0
    }

    /// What was seen and what the model makes of it, then every mask in grey.
    pub fn masks(shown: &Shown, scale: u32) -> RgbImage {
        let scene = Self::new(shown, Of::Belief);
        let size = scene.picture.dimensions();
        let grey = |mask: &dyn Fn(usize) -> u8| {
            RgbImage::from_fn(size.0, size.1, |x, y| Rgb([mask((y * size.0 + x) as usize); 3]))
        };
        let mut tiles: Vec<(String, RgbImage)> = Vec::new();
        let mut add =
            |caption: String, tile: &RgbImage| tiles.push((caption, enlarge(tile, scale)));
        if shown.seen.frame.is_some() {
            add("camera".to_owned(), &picture(shown, Of::Camera));
        }
        add("belief".to_owned(), &scene.picture);
        if let Some(agent) = &scene.agent {
            add("agent".to_owned(), &grey(&|at| agent[at]));
        }
        add("background".to_owned(), &grey(&|at| scene.background(at)));
        let dark = RgbImage::from_pixel(size.0, size.1, DARK);
        add("objects".to_owned(), &scene.tinted(dark, 1.0, false));
        for (object, mask) in &scene.objects {
            add(format!("object {}", object.id), &grey(&|at| mask[at]));
        }
        let rows: Vec<_> = tiles.chunks(COLUMNS).map(<[_]>::to_vec).collect();
        sheet(&rows)
    }

    /// What is left of a pixel beside agent and objects that are there.
    fn background(&self, at: usize) -> u8 {
        let agent = self.agent.iter().map(|mask| mask[at]);
        let objects = self.objects.iter().map(|(_, mask)| mask[at]);
        agent.chain(objects).fold(255, u8::saturating_sub)
    }

    fn colours(&self) -> BTreeMap<u64, Rgb<u8>> {
        colours(self.objects.iter().map(|(object, _)| object.id))
    }

    fn tinted(&self, mut ground: RgbImage, strength: f32, with_agent: bool) -> RgbImage {
        let agent = self.agent.iter().filter(|_| with_agent).map(|mask| (AGENT, mask));
        let colours = self.colours();
        let objects = self.objects.iter().map(|(object, mask)| (colours[&object.id], mask));
        for (colour, mask) in agent.chain(objects) {
            for (pixel, share) in ground.pixels_mut().zip(mask) {
                *pixel = mix(*pixel, colour, f32::from(*share) / 255.0 * strength);
            }
        }
        ground
    }
}

fn mix(from: Rgb<u8>, to: Rgb<u8>, share: f32) -> Rgb<u8> {
    let channel = |i: usize| {
        let (from, to) = (f32::from(from[i]), f32::from(to[i]));
        (from + (to - from) * share).round() as u8
    };
    Rgb([channel(0), channel(1), channel(2)])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene() -> Scene {
        let object = v1::Object {
            id: 1,
            presence: 1.0,
            x: 0.5,
            y: -0.5,
            width: 0.5,
            height: 0.5,
            ..v1::Object::default()
        };
        let mut mask = vec![0; 16 * 16];
        mask[4 * 16 + 12] = 255;
        let mut agent = vec![0; 16 * 16];
        agent[0] = 255;
        let picture = RgbImage::from_pixel(16, 16, Rgb([100; 3]));
        Scene { picture, agent: Some(agent), objects: vec![(object, mask)] }
    }

    #[test]
    fn masks_tint_what_they_cover() {
        let overlay = scene().overlay(1);
        assert_eq!(overlay.get_pixel(0, 0), &mix(Rgb([100; 3]), AGENT, TINT));
        assert_eq!(overlay.get_pixel(1, 15), &Rgb([100; 3]));
        let (agent, object, free) = (0, 4 * 16 + 12, 255);
        assert_eq!([agent, object, free].map(|at| scene().background(at)), [0, 0, 255]);
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

    #[test]
    fn what_the_camera_saw_is_painted_as_it_came() {
        // Colours by row and column: red, then green, then blue.
        let colours: Vec<f32> = (0..12).map(|i| i as f32 * 17.0 / 255.0).collect();
        let floats = Frame::Floats(colours.into());
        let picture = camera(&floats, 2);
        let bytes = Frame::Bytes((0..12).map(|i| i * 17).collect());
        assert_eq!(camera(&bytes, 2), picture);
        assert_eq!(bytes, Frame::Bytes(floats.floats().into_iter().map(byte).collect()));
        assert_eq!(picture.get_pixel(1, 0), &Rgb([17, 17 * 5, 17 * 9]));
        assert_eq!(picture.get_pixel(0, 1), &Rgb([34, 17 * 6, 17 * 10]));
    }
}
