//! Pictures of what came back, for people: enlarged without blur, and captioned so that they need no manual.
//!
//! [`scene`] paints one step (masks, cut-outs, overlay), [`sheet`] lays tiles out under headings, [`canvas`] draws lines
//! and letters. Numbers are measured elsewhere.

pub(crate) mod scene;
pub(crate) mod sheet;

mod canvas;

use gatsbi_client::{Array, Numbers};
use image::{Rgb, RgbImage, imageops};

/// How many times wider and higher than the model's images tiles are.
pub(crate) const ENLARGED: u32 = 3;

/// Colour of the agent.
pub(crate) const AGENT: Rgb<u8> = Rgb([0, 150, 255]);

/// Colours of objects, by identity.
const OBJECTS: [Rgb<u8>; 8] = [
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
pub(crate) fn colour_of(id: u64) -> Rgb<u8> {
    OBJECTS[(id % OBJECTS.len() as u64) as usize]
}

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
