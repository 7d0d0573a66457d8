//! Steps and rollouts as files that any program shows: PNG, and GIF where something moves.
//!
//! [`scene`] makes a step's pictures, [`rollout`] those of many, [`sheet`] lays tiles out; what is painted how is said in
//! `gatsbi-pictures`.

pub mod rollout;
pub mod scene;

mod sheet;

use bytes::Bytes;
use image::RgbImage;

use crate::media;

/// A picture as a PNG file.
pub fn png(picture: &RgbImage) -> Bytes {
    media::png(picture.as_raw(), picture.dimensions(), 3)
}

/// A number in [0, 1] as a byte.
pub fn byte(share: f32) -> u8 {
    (share.clamp(0.0, 1.0) * 255.0).round() as u8
}
