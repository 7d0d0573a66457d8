//! Steps and rollouts painted as files that any program shows: PNG, and GIF where something moves.
//!
//! [`scene`] paints one step, [`rollout`] many, [`canvas`] draws lines and letters and lays tiles out. A pixel of the
//! model becomes a square of pixels, without blur: what is coarse should look coarse.

pub mod rollout;
pub mod scene;

mod canvas;

use bytes::Bytes;
use image::{Rgb, RgbImage, imageops};

use crate::media;

/// The colour of the agent.
pub const AGENT: Rgb<u8> = Rgb([0, 150, 255]);

/// Colours of objects, by identity; the page has the same.
pub const OBJECTS: [Rgb<u8>; 8] = [
    Rgb([230, 25, 75]),
    Rgb([255, 200, 0]),
    Rgb([60, 180, 75]),
    Rgb([245, 130, 48]),
    Rgb([200, 60, 220]),
    Rgb([0, 200, 190]),
    Rgb([170, 220, 40]),
    Rgb([240, 120, 170]),
];

/// The colour of an object.
pub fn colour_of(id: u64) -> Rgb<u8> {
    OBJECTS[(id % OBJECTS.len() as u64) as usize]
}

/// A picture as a PNG file.
pub fn png(picture: &RgbImage) -> Bytes {
    media::png(picture.as_raw(), picture.dimensions(), 3)
}

/// Every pixel as a square.
pub fn enlarge(picture: &RgbImage, times: u32) -> RgbImage {
    let (width, height) = picture.dimensions();
    imageops::resize(picture, width * times, height * times, imageops::FilterType::Nearest)
}

/// A number in [0, 1] as a byte.
pub fn byte(share: f32) -> u8 {
    (share.clamp(0.0, 1.0) * 255.0).round() as u8
}
