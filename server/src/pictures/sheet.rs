//! Tiles of one size in rows, each under its caption.

use gatsbi_pictures::canvas::{Canvas, font::FONT_6X10};
use image::{Rgb, RgbImage};

const PAPER: Rgb<u8> = Rgb([255; 3]);
const INK: Rgb<u8> = Rgb([60; 3]);
const GAP: u32 = 6;
/// Height of a caption.
const CAPTION: u32 = 14;

/// Lays tiles out. A caption that is too long is cut off.
pub(super) fn sheet(rows: &[Vec<(String, RgbImage)>]) -> RgbImage {
    let tiles = || rows.iter().flatten().map(|(_, tile)| tile);
    let width = tiles().map(RgbImage::width).max().unwrap_or(1);
    let height = tiles().map(RgbImage::height).max().unwrap_or(1);
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0) as u32;
    let (wide, high) = (columns * (width + GAP), rows.len() as u32 * (height + CAPTION));
    let mut canvas = Canvas::blank(GAP + wide, GAP + high, PAPER);
    for (row, tiles) in rows.iter().enumerate() {
        for (column, (caption, tile)) in tiles.iter().enumerate() {
            let x = GAP + column as u32 * (width + GAP);
            let y = 2 + row as u32 * (height + CAPTION);
            let letters = width / FONT_6X10.character_size.width;
            let fits: String = caption.chars().take(letters as usize).collect();
            canvas.text((x as i32, y as i32), &fits, &FONT_6X10, INK, None);
            canvas.lay(tile, x, y + CAPTION - 2);
        }
    }
    canvas.0
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
}
