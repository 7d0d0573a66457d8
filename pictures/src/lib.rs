//! Decomposed scenes as pictures, the same from the server and from the command line.
//!
//! [`scene`] paints one step in the colours of [`palette`], [`canvas`] draws lines and letters. A pixel of the model becomes
//! a square of pixels, without blur: what is coarse should look coarse.

pub mod canvas;
pub mod palette;
pub mod scene;

use image::{RgbImage, imageops};

/// Every pixel as a square.
pub fn enlarge(picture: &RgbImage, times: u32) -> RgbImage {
    let (width, height) = picture.dimensions();
    imageops::resize(picture, width * times, height * times, imageops::FilterType::Nearest)
}
