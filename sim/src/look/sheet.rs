//! The contact sheet: for each of some episodes a row of frames and under it a row of their labels.

use gatsbi_episodes::{Dataset, Episode};
use image::{RgbImage, imageops};

use crate::{AGENT, BACKGROUND, FIRST_OBJECT, Result};

/// How much is shown.
#[derive(Clone, Copy, Debug)]
pub struct SheetOptions {
    /// Episodes, spread over the data set.
    pub episodes: usize,
    /// Frames of each, spread over the episode.
    pub frames: usize,
    /// Size of a pixel on the sheet.
    pub scale: u32,
}

const BACKGROUND_COLOUR: [u8; 3] = [40, 40, 40];
const AGENT_COLOUR: [u8; 3] = [255, 255, 255];
const OBJECT_COLOURS: [[u8; 3]; 9] = [
    [230, 40, 40],
    [40, 200, 40],
    [60, 90, 255],
    [240, 220, 40],
    [200, 60, 220],
    [255, 140, 0],
    [0, 200, 220],
    [255, 120, 180],
    [120, 255, 160],
];

impl Default for SheetOptions {
    fn default() -> Self {
        Self { episodes: 4, frames: 10, scale: 3 }
    }
}

/// Draws the sheet. A row of labels is left out where there are none.
pub fn sheet(dataset: &Dataset, options: SheetOptions) -> Result<RgbImage> {
    let mut rows = Vec::new();
    for index in spread(dataset.len(), options.episodes) {
        let episode = dataset.read(index)?;
        let frames = spread(episode.length(), options.frames);
        rows.push(frames.iter().map(|&t| episode.frame(t).to_vec()).collect::<Vec<_>>());
        let labels = frames.iter().map(|&t| labels(&episode, t)).collect::<Option<Vec<_>>>();
        rows.extend(labels);
    }
    let (height, width) = (dataset.info().height, dataset.info().width);
    let columns = rows.iter().map(Vec::len).max().unwrap_or_default() as u32;
    let mut sheet = RgbImage::new(columns * width, rows.len() as u32 * height);
    for (row, frames) in rows.into_iter().enumerate() {
        for (column, frame) in frames.into_iter().enumerate() {
            let Some(tile) = RgbImage::from_raw(width, height, frame) else { continue };
            let at = (column as i64 * i64::from(width), row as i64 * i64::from(height));
            imageops::replace(&mut sheet, &tile, at.0, at.1);
        }
    }
    let (width, height) = (sheet.width() * options.scale, sheet.height() * options.scale);
    Ok(imageops::resize(&sheet, width, height, imageops::FilterType::Nearest))
}

fn labels(episode: &Episode, t: usize) -> Option<Vec<u8>> {
    let colour = |&label: &u8| match label {
        BACKGROUND => BACKGROUND_COLOUR,
        AGENT => AGENT_COLOUR,
        object => OBJECT_COLOURS[usize::from(object - FIRST_OBJECT) % OBJECT_COLOURS.len()],
    };
    episode.mask(t).map(|mask| mask.iter().flat_map(colour).collect())
}

/// Up to `wanted` of `0..available`, evenly spread, the first and the last among them.
fn spread(available: usize, wanted: usize) -> Vec<usize> {
    let count = wanted.min(available);
    (0..count).map(|i| if count < 2 { 0 } else { i * (available - 1) / (count - 1) }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_reach_from_first_to_last() {
        assert_eq!(spread(40, 4), [0, 13, 26, 39]);
        assert_eq!(spread(3, 10), [0, 1, 2]);
        assert_eq!(spread(40, 1), [0]);
        assert!(spread(0, 4).is_empty());
    }
}
