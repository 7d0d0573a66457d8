//! Pictures of a source, brought to the frames of a data set, and frames as PNG.

use std::io::Cursor;

use fast_image_resize::pixels::U8x3;
use image::{
    ExtendedColorType, ImageEncoder as _, ImageFormat, ImageReader, Limits,
    codecs::png::{CompressionType, FilterType, PngEncoder},
};

use crate::{Fit, exchange::ImportProblem};

/// Greatest width and height of a picture.
pub(crate) const MAX_SIDE: u32 = 8192;

/// A picture of red, green and blue bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Picture {
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// `[H,W,3]`
    pub(crate) rgb: Vec<u8>,
}

/// The frames of an episode, as they come together.
#[derive(Clone, Debug)]
pub(crate) struct Frames {
    /// Width and height that every picture must have.
    sides: (u32, u32),
    size: Option<u32>,
    fit: Fit,
    pub(crate) rgb: Vec<u8>,
}

impl Picture {
    /// Raw bytes with the sides that they are said to have.
    pub(crate) fn raw(width: u32, height: u32, rgb: Vec<u8>) -> Result<Self, ImportProblem> {
        let sides = 1..=MAX_SIDE;
        let expected = u64::from(width) * u64::from(height) * 3;
        if !sides.contains(&width) || !sides.contains(&height) || rgb.len() as u64 != expected {
            return Err(ImportProblem::Layout {
                what: "a picture",
                found: format!("{} bytes for {width}x{height} pixels", rgb.len()),
                expected: format!("3 bytes a pixel, sides of 1 to {MAX_SIDE}"),
            });
        }
        Ok(Self { width, height, rgb })
    }

    /// A PNG, JPEG or WebP file. Grey becomes RGB, transparency is dropped.
    pub(crate) fn decode(file: &[u8]) -> Result<Self, ImportProblem> {
        let format = image::guess_format(file).ok().filter(|format| {
            matches!(format, ImageFormat::Png | ImageFormat::Jpeg | ImageFormat::WebP)
        });
        let Some(format) = format else {
            return Err(ImportProblem::Layout {
                what: "a picture",
                found: format!("{} bytes of something else", file.len()),
                expected: "a PNG, JPEG or WebP file".into(),
            });
        };
        let mut reader = ImageReader::with_format(Cursor::new(file), format);
        let mut limits = Limits::default();
        limits.max_image_width = Some(MAX_SIDE);
        limits.max_image_height = Some(MAX_SIDE);
        reader.limits(limits);
        let image = reader.decode().map_err(|e| ImportProblem::damaged("a picture", e))?;
        let image = image.into_rgb8();
        Ok(Self { width: image.width(), height: image.height(), rgb: image.into_raw() })
    }

    pub(crate) fn sides(&self) -> (u32, u32) {
        (self.width, self.height)
    }
}

impl Frames {
    /// Frames of pictures with these sides.
    pub(crate) fn new(sides: (u32, u32), size: Option<u32>, fit: Fit) -> Self {
        Self { sides, size, fit, rgb: Vec::new() }
    }

    /// Fits a picture and adds it.
    pub(crate) fn push(&mut self, picture: Picture) -> Result<(), ImportProblem> {
        if picture.sides() != self.sides {
            let text = |(width, height): (u32, u32)| format!("{width}x{height} pixels");
            return Err(ImportProblem::Layout {
                what: "a picture",
                found: text(picture.sides()),
                expected: format!("{}, as the others have", text(self.sides)),
            });
        }
        match self.size {
            None => self.rgb.extend(picture.rgb),
            Some(size) => {
                let (colours, _) = picture.rgb.as_chunks::<3>();
                let pixels: Vec<U8x3> = colours.iter().map(|&colour| U8x3::new(colour)).collect();
                let fitted = self.fit.apply(&pixels, self.sides, size);
                self.rgb.extend(fitted.iter().flat_map(|pixel| pixel.0));
            }
        }
        Ok(())
    }
}

/// A PNG of bytes `[H,W,3]`, which must be as many as the sides say.
pub(crate) fn png(rgb: &[u8], width: u32, height: u32) -> Vec<u8> {
    let mut file = Vec::new();
    PngEncoder::new_with_quality(&mut file, CompressionType::Fast, FilterType::Adaptive)
        .write_image(rgb, width, height, ExtendedColorType::Rgb8)
        .expect("the pixels are as many as the sides say, and memory can be written");
    file
}
