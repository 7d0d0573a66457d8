//! Pictures: what clients send to what models see, and masks and frames back to PNG.
//!
//! Sizes are checked before anything is decoded. An image of another size than the model's is fitted by the
//! checkpoint's rule with a triangle filter that widens with the reduction (bilinear, antialiased).

use std::{io::Cursor, sync::Arc};

use bytes::Bytes;
use fast_image_resize::{
    FilterType, PixelTrait, ResizeAlg, ResizeOptions, Resizer,
    images::{TypedImage, TypedImageRef},
    pixels::{F32x3, U8x3},
};
use gatsbi_models::world_model::Preprocess;
use gatsbi_proto::v1::{self, image::Content};
use image::{
    ExtendedColorType, ImageEncoder as _, ImageFormat, ImageReader, Limits,
    codecs::png::{CompressionType, FilterType as PngFilter, PngEncoder},
};

use crate::{error::Error, frame::Frame, tensor};

/// What pictures a model takes.
#[derive(Clone, Copy, Debug)]
pub struct Target {
    /// Height and width.
    pub size: u32,
    /// How others are fitted.
    pub preprocess: Preprocess,
    /// Greatest width and height of others.
    pub max_side: u32,
}

/// A picture as a model takes it.
#[derive(Clone, Debug)]
pub struct Fitted {
    /// What the model sees.
    pub frame: Frame,
    /// Width and height of what was sent.
    pub sent: (u32, u32),
}

/// Decodes and fits an image; `field` is its path in the request.
///
/// # Errors
/// If it is no image that is understood, too large, or not what its shape says.
pub fn fit(image: &v1::Image, field: &str, target: Target) -> Result<Fitted, Error> {
    match &image.content {
        Some(Content::Encoded(bytes)) => encoded(bytes, &format!("{field}.encoded"), target),
        Some(Content::Pixels(pixels)) => raw(pixels, &format!("{field}.pixels"), target),
        None => Err(Error::invalid(field, "empty", "an encoded image or raw pixels")),
    }
}

/// Whether decoding takes long enough to be done where it keeps nobody waiting.
pub fn is_slow(image: &v1::Image, target: Target) -> bool {
    match &image.content {
        Some(Content::Encoded(_)) => true,
        Some(Content::Pixels(pixels)) => pixels.shape != [target.size, target.size, 3],
        None => false,
    }
}

/// Where a point of the model's image, `(x, y)` in [-1, 1], lies in the image that was sent, in pixels.
pub fn sent_pixel((x, y): (f32, f32), sent: (u32, u32), preprocess: Preprocess) -> (f32, f32) {
    let along =
        |at: f32, length: u32, start: u32| (at + 1.0) * length as f32 / 2.0 - 0.5 + start as f32;
    match preprocess {
        Preprocess::Stretch => (along(x, sent.0, 0), along(y, sent.1, 0)),
        Preprocess::CentreCrop => {
            let (side, left, top) = square(sent);
            (along(x, side, left), along(y, side, top))
        }
    }
}

/// A PNG of bytes `[height, width, channels]`, 3 channels for RGB, 1 for grey.
pub fn png(pixels: &[u8], (width, height): (u32, u32), channels: usize) -> Bytes {
    let colour = if channels == 3 { ExtendedColorType::Rgb8 } else { ExtendedColorType::L8 };
    let mut file = Vec::new();
    PngEncoder::new_with_quality(&mut file, CompressionType::Fast, PngFilter::Adaptive)
        .write_image(pixels, width, height, colour)
        .expect("the pixels are as many as the size says, and memory can be written");
    Bytes::from(file)
}

fn encoded(bytes: &Bytes, field: &str, target: Target) -> Result<Fitted, Error> {
    const EXPECTED: &str = "a PNG, JPEG or WebP file";
    let length = || format!("{} bytes", bytes.len());
    let format = image::guess_format(bytes).ok().filter(|format| {
        matches!(format, ImageFormat::Png | ImageFormat::Jpeg | ImageFormat::WebP)
    });
    let format = format.ok_or_else(|| Error::invalid(field, length(), EXPECTED))?;
    let broken = |error: image::ImageError| {
        Error::invalid(field, format!("{} that cannot be read ({error})", length()), EXPECTED)
    };
    let reader = || ImageReader::with_format(Cursor::new(bytes), format);
    let sent = reader().into_dimensions().map_err(broken)?;
    check_size(sent, field, target)?;
    let mut reader = reader();
    let mut limits = Limits::default();
    limits.max_image_width = Some(target.max_side);
    limits.max_image_height = Some(target.max_side);
    reader.limits(limits);
    let image = reader.decode().map_err(broken)?.into_rgb8();
    let pixels: Vec<U8x3> = image.pixels().map(|pixel| U8x3::new(pixel.0)).collect();
    Ok(fitted(&pixels, sent, target))
}

fn raw(pixels: &v1::Tensor, field: &str, target: Target) -> Result<Fitted, Error> {
    let &[height, width, 3] = pixels.shape.as_slice() else {
        let found = format!("{:?}", pixels.shape);
        return Err(Error::invalid(format!("{field}.shape"), found, "[height, width, 3]"));
    };
    let sent = (width, height);
    check_size(sent, field, target)?;
    match pixels.dtype() {
        v1::DataType::U8 => {
            let bytes = tensor::bytes(pixels, field)?;
            let (colours, _) = bytes.as_chunks::<3>();
            let pixels: Vec<U8x3> = colours.iter().map(|colour| U8x3::new(*colour)).collect();
            Ok(fitted(&pixels, sent, target))
        }
        v1::DataType::F32 => {
            let numbers = tensor::floats(pixels, field)?;
            if let Some(at) = numbers.iter().position(|x| !(0.0..=1.0).contains(x)) {
                let field = format!("{field}.data[{at}]");
                return Err(Error::invalid(field, numbers[at], "a number in [0, 1]"));
            }
            let (colours, _) = numbers.as_chunks::<3>();
            let pixels: Vec<F32x3> = colours.iter().map(|colour| F32x3::new(*colour)).collect();
            Ok(fitted(&pixels, sent, target))
        }
        _ => {
            let found = pixels.dtype().as_str_name();
            let expected = "DATA_TYPE_U8 or DATA_TYPE_F32";
            Err(Error::invalid(format!("{field}.dtype"), found, expected))
        }
    }
}

fn check_size((width, height): (u32, u32), field: &str, target: Target) -> Result<(), Error> {
    let range = 1..=target.max_side;
    if range.contains(&width) && range.contains(&height) {
        return Ok(());
    }
    let expected = format!("width and height of 1 to {} pixels", target.max_side);
    Err(Error::invalid(field, format!("{width} x {height} pixels"), expected))
}

/// A pixel of three colours.
trait Colours: PixelTrait {
    /// Their frame, colours apart.
    fn frame(pixels: &[Self]) -> Frame;
}

impl Colours for U8x3 {
    fn frame(pixels: &[Self]) -> Frame {
        Frame::Bytes(apart(pixels, |pixel, colour| pixel.0[colour]))
    }
}

impl Colours for F32x3 {
    fn frame(pixels: &[Self]) -> Frame {
        // The filter's weights add up to one, but for rounding.
        Frame::Floats(apart(pixels, |pixel, colour| pixel.0[colour].clamp(0.0, 1.0)))
    }
}

/// Fits pixels to the model's size and brings their colours apart.
fn fitted<P: Colours>(pixels: &[P], sent: (u32, u32), target: Target) -> Fitted {
    let size = target.size;
    if sent == (size, size) {
        return Fitted { frame: P::frame(pixels), sent };
    }
    let cropped: Vec<P>;
    let (pixels, width, height) = match target.preprocess {
        Preprocess::Stretch => (pixels, sent.0, sent.1),
        Preprocess::CentreCrop => {
            let (side, left, top) = square(sent);
            let rows = pixels.chunks_exact(sent.0 as usize).skip(top as usize).take(side as usize);
            cropped =
                rows.flat_map(|row| &row[left as usize..][..side as usize]).copied().collect();
            (cropped.as_slice(), side, side)
        }
    };
    let source = TypedImageRef::new(width, height, pixels).expect("as many pixels as sizes say");
    let mut fitted = TypedImage::<P>::new(size, size);
    let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(FilterType::Bilinear));
    Resizer::new()
        .resize_typed(&source, &mut fitted, &options)
        .expect("nothing is cropped, and neither size is zero");
    Fitted { frame: P::frame(fitted.pixels()), sent }
}

/// The largest centred square: its side, and where it begins from the left and from the top.
fn square((width, height): (u32, u32)) -> (u32, u32, u32) {
    let side = width.min(height);
    (side, (width - side) / 2, (height - side) / 2)
}

/// All of the first colour, then of the second, then of the third.
fn apart<P, C>(pixels: &[P], colour: impl Fn(&P, usize) -> C) -> Arc<[C]> {
    let colour = &colour;
    (0..3).flat_map(|c| pixels.iter().map(move |pixel| colour(pixel, c))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const TARGET: Target = Target { size: 4, preprocess: Preprocess::Stretch, max_side: 64 };

    fn grid(width: u32, height: u32) -> Vec<u8> {
        (0..width * height * 3).map(|i| (i * 37 % 251) as u8).collect()
    }

    fn u8_image(width: u32, height: u32, data: Vec<u8>) -> v1::Image {
        let pixels = v1::Tensor {
            dtype: v1::DataType::U8.into(),
            shape: vec![height, width, 3],
            data: data.into(),
            values: Vec::new(),
        };
        v1::Image { content: Some(Content::Pixels(pixels)) }
    }

    fn f32_image(width: u32, height: u32, values: Vec<f32>) -> v1::Image {
        let pixels = v1::Tensor {
            dtype: v1::DataType::F32.into(),
            shape: vec![height, width, 3],
            data: Bytes::new(),
            values,
        };
        v1::Image { content: Some(Content::Pixels(pixels)) }
    }

    fn field_of(result: Result<Fitted, Error>) -> (String, String) {
        match result.unwrap_err() {
            Error::InvalidFields(fields) => (fields[0].field.clone(), fields[0].value.clone()),
            error => panic!("{error}"),
        }
    }

    #[test]
    fn all_ways_to_send_the_same_pixels_agree() {
        let bytes = grid(4, 4);
        let raw = fit(&u8_image(4, 4, bytes.clone()), "image", TARGET).unwrap();
        let green = f32::from(bytes[5 * 3 + 1]) / 255.0;
        assert_eq!(raw.frame.floats()[16 + 5..][..1], [green], "green of pixel 5");
        assert_eq!(raw.frame.bytes(), 48, "a byte is kept as a byte");
        let floats = bytes.iter().map(|byte| f32::from(*byte) / 255.0).collect();
        let file = v1::Image { content: Some(Content::Encoded(png(&bytes, (4, 4), 3))) };
        for same in [f32_image(4, 4, floats), file] {
            assert_eq!(fit(&same, "image", TARGET).unwrap().frame.floats(), raw.frame.floats());
        }
    }

    #[test]
    fn other_sizes_are_fitted_by_the_rule() {
        // Left half black, right half white, on a field that is twice as wide as high.
        let bytes: Vec<u8> =
            (0..32).flat_map(|_| (0..64).flat_map(|x| [if x < 32 { 0 } else { 255 }; 3])).collect();
        let image = u8_image(64, 32, bytes);
        for preprocess in [Preprocess::Stretch, Preprocess::CentreCrop] {
            let fitted = fit(&image, "image", Target { preprocess, ..TARGET }).unwrap();
            assert_eq!(fitted.sent, (64, 32));
            let row = &fitted.frame.floats()[..4];
            assert_eq!((row[0], row[3]), (0.0, 1.0));
            // The filter reaches one model pixel to either side.
            assert!((0.05..0.2).contains(&row[1]) && (0.8..0.95).contains(&row[2]), "{row:?}");
        }
        // A white frame around a black square: the crop loses the sides only.
        let bytes: Vec<u8> = (0..16)
            .flat_map(|_| (0..48).flat_map(|x| [if (16..32).contains(&x) { 0 } else { 255 }; 3]))
            .collect();
        let target = Target { preprocess: Preprocess::CentreCrop, ..TARGET };
        let fitted = fit(&u8_image(48, 16, bytes), "image", target).unwrap();
        assert!(fitted.frame.floats().iter().all(|x| *x == 0.0), "{:?}", fitted.frame);
    }

    #[test]
    fn points_are_found_again_in_what_was_sent() {
        let centre = |preprocess| sent_pixel((0.0, 0.0), (640, 480), preprocess);
        assert_eq!(centre(Preprocess::Stretch), (319.5, 239.5));
        assert_eq!(centre(Preprocess::CentreCrop), (319.5, 239.5));
        let corner = |preprocess| sent_pixel((-1.0, -1.0), (640, 480), preprocess);
        assert_eq!(corner(Preprocess::Stretch), (-0.5, -0.5));
        assert_eq!(corner(Preprocess::CentreCrop), (79.5, -0.5));
    }

    #[test]
    fn what_is_no_image_is_refused_by_field() {
        let encoded = |bytes: &[u8]| v1::Image {
            content: Some(Content::Encoded(Bytes::copy_from_slice(bytes))),
        };
        let refused = |image: &v1::Image| field_of(fit(image, "image", TARGET));
        assert_eq!(refused(&v1::Image { content: None }).0, "image");
        assert_eq!(refused(&encoded(b"GIF89a?")).0, "image.encoded");
        let file = png(&grid(8, 8), (8, 8), 3);
        assert_eq!(refused(&encoded(&file[..60])).0, "image.encoded");
        let wide = png(&grid(65, 2), (65, 2), 3);
        assert_eq!(refused(&encoded(&wide)), ("image.encoded".into(), "65 x 2 pixels".into()));
        let (field, value) = refused(&u8_image(4, 4, vec![0; 47]));
        assert_eq!((field.as_str(), value.as_str()), ("image.pixels.data", "47 bytes"));
        assert_eq!(refused(&u8_image(0, 4, vec![])).1, "0 x 4 pixels");
        let mut values = vec![0.5; 48];
        values[7] = f32::NAN;
        assert_eq!(refused(&f32_image(4, 4, values)).0, "image.pixels.data[7]");
    }

    #[test]
    fn size_is_checked_before_decoding() {
        // A header that promises 60000 x 60000 pixels and has none of them.
        let mut file = png(&grid(8, 8), (8, 8), 3).to_vec();
        let at = file.windows(4).position(|window| window == b"IHDR").unwrap() + 4;
        file[at..at + 4].copy_from_slice(&60_000u32.to_be_bytes());
        file[at + 4..at + 8].copy_from_slice(&60_000u32.to_be_bytes());
        let crc = crc_of(&file[at - 4..at + 13]);
        file[at + 13..at + 17].copy_from_slice(&crc.to_be_bytes());
        let image = v1::Image { content: Some(Content::Encoded(file.into())) };
        assert_eq!(field_of(fit(&image, "image", TARGET)).1, "60000 x 60000 pixels");
    }

    /// The checksum of PNG chunks.
    fn crc_of(bytes: &[u8]) -> u32 {
        !bytes.iter().fold(u32::MAX, |crc, byte| {
            (0..8).fold(crc ^ u32::from(*byte), |crc, _| {
                (crc >> 1) ^ (0xEDB8_8320 & (crc & 1).wrapping_neg())
            })
        })
    }
}
