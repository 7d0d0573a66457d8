//! Pictures of what came back, for people: enlarged without blur, and captioned so that they need no manual.
//!
//! [`scene`] makes a step's picture of what came, [`sheet`] lays tiles out under headings. Numbers are measured elsewhere.

pub(crate) mod scene;
pub(crate) mod sheet;

use gatsbi_client::{Array, Numbers};
use image::RgbImage;

/// How many times wider and higher than the model's images tiles are.
pub(crate) const ENLARGED: u32 = 3;

/// An image `[H, W, 3]` that came as bytes.
pub(crate) fn image(array: &Array) -> Option<RgbImage> {
    let (&[height, width, 3], Numbers::U8(bytes)) = (array.shape(), array.numbers()) else {
        return None;
    };
    RgbImage::from_raw(width as u32, height as u32, bytes.clone())
}
