//! Pictures of one size made to fit another: the one place where importers resample pixels.
//!
//! Rules, library and filter are those of the server (`server/src/media.rs`), so that a model sees in service what it was
//! trained on; the server holds no episodes, hence two places. The filter is a triangle that widens with the reduction (bilinear, antialiased). A picture of the right size is left
//! as it is, bit for bit.

use fast_image_resize::{
    FilterType, PixelTrait, ResizeAlg, ResizeOptions, Resizer,
    images::{TypedImage, TypedImageRef},
};

/// How a picture is brought to another shape.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Fit {
    /// Both sides to the size.
    #[default]
    Stretch,
    /// The largest centred square, then to the size.
    CentreCrop,
}

impl Fit {
    /// Pixels of a picture of `width` by `height`, fitted to a square of `size`. Panics if the pixels are not as many as the
    /// sides say, or a side is 0.
    pub fn apply<P: PixelTrait>(
        self,
        pixels: &[P],
        (width, height): (u32, u32),
        size: u32,
    ) -> Vec<P> {
        assert_eq!(pixels.len() as u64, u64::from(width) * u64::from(height));
        assert!(width > 0 && height > 0 && size > 0);
        let cropped: Vec<P>;
        let (pixels, width, height) = match self {
            Self::Stretch => (pixels, width, height),
            Self::CentreCrop => {
                let (side, left, top) = centre_square((width, height));
                let rows = pixels.chunks_exact(width as usize).skip(top as usize);
                cropped = rows
                    .take(side as usize)
                    .flat_map(|row| &row[left as usize..][..side as usize])
                    .copied()
                    .collect();
                (cropped.as_slice(), side, side)
            }
        };
        if (width, height) == (size, size) {
            return pixels.to_vec();
        }
        let source = TypedImageRef::new(width, height, pixels).expect("as many as sides say");
        let mut fitted = TypedImage::<P>::new(size, size);
        let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(FilterType::Bilinear));
        Resizer::new()
            .resize_typed(&source, &mut fitted, &options)
            .expect("nothing is cropped, and no side is zero");
        fitted.pixels().to_vec()
    }
}

/// The largest centred square of a picture: its side, and where it begins from the left and from the top.
fn centre_square((width, height): (u32, u32)) -> (u32, u32, u32) {
    let side = width.min(height);
    (side, (width - side) / 2, (height - side) / 2)
}

#[cfg(test)]
mod tests {
    use fast_image_resize::pixels::U8x3;

    use super::*;

    fn grey(values: &[u8]) -> Vec<U8x3> {
        values.iter().map(|&value| U8x3::new([value; 3])).collect()
    }

    #[test]
    fn the_right_size_is_left_alone() {
        let pixels = grey(&[1, 2, 3, 4]);
        for fit in [Fit::Stretch, Fit::CentreCrop] {
            assert_eq!(fit.apply(&pixels, (2, 2), 2), pixels);
        }
    }

    #[test]
    fn a_crop_loses_the_sides_and_a_stretch_does_not() {
        let pixels = grey(&[0, 8, 8, 0, 0, 8, 8, 0]);
        assert_eq!(Fit::CentreCrop.apply(&pixels, (4, 2), 2), grey(&[8; 4]));
        assert_eq!(Fit::CentreCrop.apply(&pixels, (4, 2), 1), grey(&[8]));
        assert_eq!(Fit::Stretch.apply(&pixels, (4, 2), 1), grey(&[5]));
    }
}
