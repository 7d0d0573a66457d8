//! A picture to draw on, and tiles under captions.

use std::convert::Infallible;

use embedded_graphics::{
    Drawable as _, Pixel,
    draw_target::DrawTarget,
    geometry::{OriginDimensions, Point, Size},
    mono_font::{MonoTextStyleBuilder, ascii::FONT_6X10},
    pixelcolor::{Rgb888, RgbColor as _},
    primitives::{Primitive as _, PrimitiveStyle, Rectangle},
    text::{Baseline, Text},
};
use image::{Rgb, RgbImage};

const PAPER: Rgb<u8> = Rgb([255; 3]);
const INK: Rgb<u8> = Rgb([60; 3]);
const GAP: u32 = 6;
/// Height of a caption.
pub(super) const CAPTION: u32 = 14;
/// Width of a letter.
const LETTER: u32 = 6;

/// A picture to draw on; what lies outside is cut off.
pub(super) struct Canvas(pub(super) RgbImage);

impl Canvas {
    /// The outline of a rectangle, drawn inwards.
    pub(super) fn outline(&mut self, at: (i32, i32), size: (u32, u32), colour: Rgb<u8>) {
        let rectangle = Rectangle::new(Point::new(at.0, at.1), Size::new(size.0, size.1));
        let style = PrimitiveStyle::with_stroke(rgb(colour), 1);
        let Ok(()) = rectangle.into_styled(style).draw(self);
    }

    /// Letters with their upper left corner at `at`, on a ground of their own if one is given.
    pub(super) fn text(
        &mut self,
        at: (i32, i32),
        text: &str,
        colour: Rgb<u8>,
        ground: Option<Rgb<u8>>,
    ) {
        let mut style = MonoTextStyleBuilder::new().font(&FONT_6X10).text_color(rgb(colour));
        if let Some(ground) = ground {
            style = style.background_color(rgb(ground));
        }
        let at = Point::new(at.0, at.1);
        let Ok(_) = Text::with_baseline(text, at, style.build(), Baseline::Top).draw(self);
    }
}

impl OriginDimensions for Canvas {
    fn size(&self) -> Size {
        Size::new(self.0.width(), self.0.height())
    }
}

impl DrawTarget for Canvas {
    type Color = Rgb888;
    type Error = Infallible;

    fn draw_iter<I: IntoIterator<Item = Pixel<Rgb888>>>(
        &mut self,
        pixels: I,
    ) -> Result<(), Infallible> {
        for Pixel(at, colour) in pixels {
            let (Ok(x), Ok(y)) = (u32::try_from(at.x), u32::try_from(at.y)) else { continue };
            if let Some(pixel) = self.0.get_pixel_mut_checked(x, y) {
                *pixel = Rgb([colour.r(), colour.g(), colour.b()]);
            }
        }
        Ok(())
    }
}

/// Tiles of one size in rows, each under its caption. A caption that is too long is cut off.
pub(super) fn sheet(rows: &[Vec<(String, RgbImage)>]) -> RgbImage {
    let tiles = || rows.iter().flatten().map(|(_, tile)| tile);
    let width = tiles().map(RgbImage::width).max().unwrap_or(1);
    let height = tiles().map(RgbImage::height).max().unwrap_or(1);
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0) as u32;
    let size = (GAP + columns * (width + GAP), GAP + rows.len() as u32 * (height + CAPTION));
    let mut canvas = Canvas(RgbImage::from_pixel(size.0, size.1, PAPER));
    for (row, tiles) in rows.iter().enumerate() {
        for (column, (caption, tile)) in tiles.iter().enumerate() {
            let x = GAP + column as u32 * (width + GAP);
            let y = 2 + row as u32 * (height + CAPTION);
            let fits: String = caption.chars().take((width / LETTER) as usize).collect();
            canvas.text((x as i32, y as i32), &fits, INK, None);
            image::imageops::replace(&mut canvas.0, tile, x.into(), (y + CAPTION - 2).into());
        }
    }
    canvas.0
}

fn rgb(Rgb([r, g, b]): Rgb<u8>) -> Rgb888 {
    Rgb888::new(r, g, b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sheet_holds_all_of_its_tiles() {
        let red = Rgb([200, 0, 0]);
        let tile = || ("a long caption".to_owned(), RgbImage::from_pixel(20, 10, red));
        let sheet = sheet(&[vec![tile(), tile()], vec![tile()]]);
        assert_eq!(sheet.dimensions(), (6 + 2 * 26, 6 + 2 * 24));
        assert_eq!(sheet.pixels().filter(|pixel| **pixel == red).count(), 3 * 200);
        assert!(sheet.pixels().any(|pixel| *pixel == INK));
        let right = (sheet.width() - GAP..sheet.width())
            .all(|x| (0..sheet.height()).all(|y| *sheet.get_pixel(x, y) == PAPER));
        assert!(right, "a caption reaches into the margin");
    }

    #[test]
    fn what_lies_outside_is_cut_off() {
        let mut canvas = Canvas(RgbImage::from_pixel(8, 8, PAPER));
        canvas.outline((-2, -2), (6, 6), INK);
        assert_eq!(canvas.0.get_pixel(3, 0), &INK);
        assert_eq!(canvas.0.get_pixel(0, 0), &PAPER);
    }
}
