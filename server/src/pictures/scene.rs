//! A step's pictures: as it was seen, as the model has it, its masks, and all of it in one.

use gatsbi_models::scene::Output;
use gatsbi_pictures::{
    enlarge,
    scene::{Object, PRESENT, Scene, grey},
};
use gatsbi_proto::v1;
use image::{Rgb, RgbImage};

use super::{byte, sheet::sheet};
use crate::{frame::Frame, sessions::live::Shown};

/// Tiles of a row of the sheet of masks.
const COLUMNS: usize = 5;

/// Which picture of a step.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub enum Of {
    /// What was observed, as the model takes it.
    #[default]
    Camera,
    /// What the model makes of it.
    Belief,
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

/// A step that is shown, to be painted.
pub fn scene(shown: &Shown, of: Of) -> Scene {
    let masks = shown.floats(Output::ObjectMasks).unwrap_or_default();
    let pixels = (shown.image_size * shown.image_size) as usize;
    Scene {
        picture: picture(shown, of),
        agent: shown.floats(Output::AgentMask),
        objects: painted(&shown.objects, |slot| {
            Some(masks.get(slot * pixels..)?.get(..pixels)?.to_vec())
        }),
    }
}

/// Those objects that are there and have a mask, with it.
pub(super) fn painted(
    objects: &[v1::Object],
    mask: impl Fn(usize) -> Option<Vec<f32>>,
) -> Vec<(Object, Vec<f32>)> {
    let there = objects.iter().filter(|object| object.presence > PRESENT);
    let painted = there.filter_map(|told| {
        let v1::Object { id, presence, x, y, width, height, .. } = *told;
        Some((Object { id, presence, x, y, width, height }, mask(told.slot as usize)?))
    });
    painted.collect()
}

/// What was seen and what the model makes of it, then every mask in grey.
pub fn masks(shown: &Shown, scale: u32) -> RgbImage {
    let scene = scene(shown, Of::Belief);
    let size = scene.picture.dimensions();
    let mut tiles: Vec<(String, RgbImage)> = Vec::new();
    let mut add = |caption: String, tile: &RgbImage| tiles.push((caption, enlarge(tile, scale)));
    if shown.seen.frame.is_some() {
        add("camera".to_owned(), &picture(shown, Of::Camera));
    }
    add("belief".to_owned(), &scene.picture);
    if let Some(agent) = &scene.agent {
        add("agent".to_owned(), &grey(size, agent));
    }
    add("background".to_owned(), &grey(size, &background(&scene)));
    add("objects".to_owned(), &scene.objects_alone());
    for (object, mask) in &scene.objects {
        add(format!("object {}", object.id), &grey(size, mask));
    }
    let rows: Vec<_> = tiles.chunks(COLUMNS).map(<[_]>::to_vec).collect();
    sheet(&rows)
}

/// What is left beside agent and objects that are there.
fn background(scene: &Scene) -> Vec<f32> {
    let mut left = vec![1.0; scene.picture.pixels().len()];
    for mask in scene.agent.iter().chain(scene.objects.iter().map(|(_, mask)| mask)) {
        for (left, share) in left.iter_mut().zip(mask) {
            *left -= share;
        }
    }
    left
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_background_is_what_nothing_else_covers() {
        let told = v1::Object { id: 1, presence: 1.0, slot: 1, ..v1::Object::default() };
        let gone = v1::Object { presence: 0.2, ..told };
        let masks = [vec![0.5; 4], vec![0.0, 1.0, 0.0, 0.25]];
        let scene = Scene {
            picture: RgbImage::new(2, 2),
            agent: Some(vec![1.0, 0.0, 0.0, 0.25]),
            objects: painted(&[told, gone], |slot| masks.get(slot).cloned()),
        };
        assert_eq!(background(&scene), [0.0, 0.0, 1.0, 0.5]);
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
