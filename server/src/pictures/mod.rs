//! Steps and rollouts painted as files that any program shows: PNG, and GIF where something moves.
//!
//! [`scene`] paints one step, [`rollout`] many, in the colours of [`palette`]; [`canvas`] draws lines and letters and
//! lays tiles out. A pixel of the model becomes a square of pixels, without blur: what is coarse should look coarse.

pub mod palette;
pub mod rollout;
pub mod scene;

mod canvas;

use bytes::Bytes;
use image::{RgbImage, imageops};

use crate::media;

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
