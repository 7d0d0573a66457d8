//! Tiles in rows, each row under a heading, each tile over its caption.

use std::path::Path;

use anyhow::Context as _;
use gatsbi_pictures::canvas::{
    Canvas, MonoFont,
    font::{FONT_6X13, FONT_6X13_BOLD, FONT_8X13_BOLD},
};
use image::{Rgb, RgbImage};

const PAPER: Rgb<u8> = Rgb([255; 3]);
const INK: Rgb<u8> = Rgb([30; 3]);
const FAINT: Rgb<u8> = Rgb([110; 3]);

const MARGIN: u32 = 14;
const GAP: u32 = 6;
const LINE: u32 = 14;
const TITLE: &MonoFont<'_> = &FONT_8X13_BOLD;
const HEADING: &MonoFont<'_> = &FONT_6X13_BOLD;
const CAPTION: &MonoFont<'_> = &FONT_6X13;

/// A page of pictures.
#[derive(Debug, Default)]
pub(crate) struct Sheet {
    /// What it shows, one line.
    pub(crate) title: String,
    /// From top to bottom.
    pub(crate) rows: Vec<Row>,
}

/// A row of pictures.
#[derive(Debug, Default)]
pub(crate) struct Row {
    /// What it shows, one line.
    pub(crate) heading: String,
    /// From left to right.
    pub(crate) tiles: Vec<Tile>,
}

/// A picture with its caption.
#[derive(Debug)]
pub(crate) struct Tile {
    /// The picture in its final size.
    pub(crate) picture: RgbImage,
    /// Lines below it, cut at its width.
    pub(crate) caption: Vec<String>,
}

impl Tile {
    pub(crate) fn new(picture: RgbImage, caption: &[&str]) -> Self {
        Self { picture, caption: caption.iter().map(|&line| line.to_owned()).collect() }
    }
}

impl Row {
    fn size(&self) -> (u32, u32) {
        let tiles: u32 = self.tiles.iter().map(|tile| tile.picture.width() + GAP).sum();
        let height = |tile: &Tile| tile.picture.height() + 3 + LINE * tile.caption.len() as u32;
        let heading = if self.heading.is_empty() { 0 } else { LINE + 4 };
        let highest = self.tiles.iter().map(height).max().unwrap_or(0);
        (tiles.saturating_sub(GAP).max(width_of(&self.heading, HEADING)), heading + highest)
    }
}

impl Sheet {
    /// Writes the page as a PNG file.
    pub(crate) fn save(&self, path: &Path) -> anyhow::Result<()> {
        save(&self.paint(), path)
    }

    fn paint(&self) -> RgbImage {
        let sizes: Vec<_> = self.rows.iter().map(Row::size).collect();
        let widest = sizes.iter().map(|size| size.0).max().unwrap_or(0);
        let width = widest.max(width_of(&self.title, TITLE)) + 2 * MARGIN;
        let heights: u32 = sizes.iter().map(|size| size.1 + 2 * GAP).sum();
        let mut canvas = Canvas::blank(width, heights + LINE + 2 * MARGIN, PAPER);
        canvas.text((MARGIN as i32, MARGIN as i32), &self.title, TITLE, INK, None);
        let mut y = MARGIN + LINE + 2 * GAP;
        for (row, (_, height)) in self.rows.iter().zip(sizes) {
            paint_row(&mut canvas, row, y);
            y += height + 2 * GAP;
        }
        canvas.0
    }
}

/// Writes a picture as a PNG file.
pub(crate) fn save(picture: &RgbImage, path: &Path) -> anyhow::Result<()> {
    picture.save(path).with_context(|| format!("{} cannot be written", path.display()))
}

fn paint_row(canvas: &mut Canvas, row: &Row, mut y: u32) {
    if !row.heading.is_empty() {
        canvas.text((MARGIN as i32, y as i32), &row.heading, HEADING, INK, None);
        y += LINE + 4;
    }
    let mut x = MARGIN;
    for Tile { picture, caption } in &row.tiles {
        canvas.lay(picture, x, y);
        for (number, line) in caption.iter().enumerate() {
            let below = y + picture.height() + 3 + LINE * number as u32;
            let fits = (picture.width() + GAP) / CAPTION.character_size.width;
            let line: String = line.chars().take(fits as usize).collect();
            canvas.text((x as i32, below as i32), &line, CAPTION, FAINT, None);
        }
        x += picture.width() + GAP;
    }
}

fn width_of(text: &str, font: &MonoFont<'_>) -> u32 {
    text.chars().count() as u32 * font.character_size.width
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_holds_all_tiles_and_words() {
        let colour = Rgb([200, 0, 0]);
        let tile = || Tile::new(RgbImage::from_pixel(20, 10, colour), &["step 1", "22 dB"]);
        let row = |n| Row { heading: "what".into(), tiles: (0..n).map(|_| tile()).collect() };
        let sheet = Sheet { title: "a title of some length".into(), rows: vec![row(1), row(3)] };
        let picture = sheet.paint();
        assert_eq!(picture.width(), 22 * 8 + 2 * MARGIN);
        assert_eq!(picture.pixels().filter(|pixel| **pixel == colour).count(), 4 * 200);
        let last_line = picture.rows().rev().take((MARGIN + 2 * GAP + LINE) as usize);
        assert!(last_line.flatten().any(|pixel| *pixel == FAINT));
        let right = (picture.width() - MARGIN..picture.width())
            .all(|x| (0..picture.height()).all(|y| *picture.get_pixel(x, y) == PAPER));
        assert!(right, "something was drawn into the margin");
    }
}
