//! Pictures of what came back, for people: enlarged without blur, and captioned so that they need no manual.
//!
//! [`scene`] paints one step (masks, cut-outs, overlay) in the colours of [`palette`], [`sheet`] lays tiles out under
//! headings, [`canvas`] draws lines and letters. Numbers are measured elsewhere.

pub(crate) mod palette;
pub(crate) mod scene;
pub(crate) mod sheet;

mod canvas;

use gatsbi_client::{Array, Numbers};
use image::{RgbImage, imageops};

/// How many times wider and higher than the model's images tiles are.
pub(crate) const ENLARGED: u32 = 3;

/// Every pixel as a square.
pub(crate) fn enlarge(picture: &RgbImage, times: u32) -> RgbImage {
    let (width, height) = picture.dimensions();
    imageops::resize(picture, width * times, height * times, imageops::FilterType::Nearest)
}

/// An image `[H, W, 3]` that came as bytes.
pub(crate) fn image(array: &Array) -> Option<RgbImage> {
    let (&[height, width, 3], Numbers::U8(bytes)) = (array.shape(), array.numbers()) else {
        return None;
    };
    RgbImage::from_raw(width as u32, height as u32, bytes.clone())
}
