//! A picture that lines and letters can be drawn on, through embedded-graphics.

use std::convert::Infallible;

use embedded_graphics::{
    Pixel,
    draw_target::DrawTarget,
    geometry::{OriginDimensions, Point, Size},
    mono_font::MonoTextStyleBuilder,
    pixelcolor::{Rgb888, RgbColor as _},
    prelude::Primitive as _,
    primitives::{PrimitiveStyle, Rectangle},
    text::{Baseline, Text},
};
use image::{Rgb, RgbImage};

pub use embedded_graphics::mono_font::{MonoFont, ascii as font};

/// A picture to draw on; what lies outside is cut off.
#[derive(Debug)]
pub struct Canvas(pub RgbImage);

impl Canvas {
    /// One colour.
    pub fn blank(width: u32, height: u32, colour: Rgb<u8>) -> Self {
        Self(RgbImage::from_pixel(width, height, colour))
    }

    /// Lays a picture with its upper left corner at `(x, y)`.
    pub fn lay(&mut self, picture: &RgbImage, x: u32, y: u32) {
        image::imageops::replace(&mut self.0, picture, x.into(), y.into());
    }

    /// The outline of a rectangle with its upper left corner at `(x, y)`, drawn inwards.
    pub fn outline(&mut self, at: (i32, i32), size: (u32, u32), colour: Rgb<u8>) {
        let rectangle = Rectangle::new(Point::new(at.0, at.1), Size::new(size.0, size.1));
        let style = PrimitiveStyle::with_stroke(colour_of(colour), 1);
        drawn(embedded_graphics::Drawable::draw(&rectangle.into_styled(style), self));
    }

    /// Letters with their upper left corner at `(x, y)`, on a ground of their own if one is given.
    pub fn text(
        &mut self,
        at: (i32, i32),
        text: &str,
        font: &MonoFont<'_>,
        colour: Rgb<u8>,
        ground: Option<Rgb<u8>>,
    ) {
        let mut style = MonoTextStyleBuilder::new().font(font).text_color(colour_of(colour));
        if let Some(ground) = ground {
            style = style.background_color(colour_of(ground));
        }
        let text = Text::with_baseline(text, Point::new(at.0, at.1), style.build(), Baseline::Top);
        drawn(embedded_graphics::Drawable::draw(&text, self).map(|_| ()));
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

fn colour_of(Rgb([r, g, b]): Rgb<u8>) -> Rgb888 {
    Rgb888::new(r, g, b)
}

fn drawn(result: Result<(), Infallible>) {
    let Ok(()) = result;
}

#[cfg(test)]
mod tests {
    use super::{font::FONT_6X10, *};

    #[test]
    fn what_lies_outside_is_cut_off() {
        let (white, black) = (Rgb([255; 3]), Rgb([0; 3]));
        let mut canvas = Canvas::blank(8, 8, white);
        canvas.outline((-2, -2), (6, 6), black);
        canvas.text((5, 5), "W", &FONT_6X10, black, None);
        assert_eq!(canvas.0.get_pixel(3, 0), &black);
        assert_eq!(canvas.0.get_pixel(0, 3), &black);
        assert_eq!(canvas.0.get_pixel(2, 2), &white);
        assert!(canvas.0.pixels().filter(|pixel| **pixel == black).count() > 7);
    }
}
