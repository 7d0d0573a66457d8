//! A rollout painted: a strip with a candidate a row, or a film with the candidates side by side.

use std::{collections::BTreeMap, time::Duration};

use gatsbi_pictures::{enlarge, scene::Scene};
use gatsbi_proto::v1::{self, output_value::Value};
use image::{Delay, DynamicImage, Frame, RgbImage, codecs::gif};

use super::{scene::painted, sheet::sheet};

/// Speed of choosing a film's colours, of 1 to 30; it is no more than a few colours that differ.
const SPEED: i32 = 20;
/// How long a film's last frame stays, in frames.
const REST: u32 = 4;
/// Candidates side by side in a film.
const COLUMNS: usize = 8;

/// The pictures of a rollout, by candidate and depth.
#[derive(Debug, Default)]
pub struct Pictures {
    tiles: BTreeMap<(u32, u32), RgbImage>,
}

impl Pictures {
    /// Adds a chunk with frames as bytes; masks and objects are painted over them where they came too.
    pub fn add(&mut self, chunk: &v1::RolloutChunk, scale: u32) {
        let tensor = |output: v1::Output| {
            let value = chunk.outputs.iter().find(|value| value.output() == output)?;
            match value.value.as_ref()? {
                Value::Tensor(tensor) => Some(tensor),
                _ => None,
            }
        };
        let Some(frames) = tensor(v1::Output::Frame) else { return };
        let [rows, depths, height, width, 3] = frames.shape[..] else { return };
        let row = |tensor: &v1::Tensor, at: u32| {
            let bytes = tensor.data.len() / (rows * depths) as usize;
            tensor.data.slice(at as usize * bytes..(at as usize + 1) * bytes)
        };
        for at in 0..rows * depths {
            let Some(picture) = RgbImage::from_raw(width, height, row(frames, at).to_vec()) else {
                return;
            };
            let shares = |bytes: &[u8]| bytes.iter().map(|byte| f32::from(*byte) / 255.0).collect();
            let agent = tensor(v1::Output::AgentMask).map(|masks| shares(&row(masks, at)));
            let masks = tensor(v1::Output::ObjectMasks).map(|masks| row(masks, at));
            let pixels = (width * height) as usize;
            let objects = painted(&objects(chunk, at, rows * depths), |slot| {
                Some(shares(masks.as_ref()?.get(slot * pixels..)?.get(..pixels)?))
            });
            let scene = Scene { picture, agent, objects };
            let tile = match masks {
                Some(_) => scene.overlay(scale),
                None => enlarge(&scene.picture, scale),
            };
            let (candidate, depth) = (chunk.first_candidate + at / depths, at % depths);
            self.tiles.insert((candidate, chunk.depths[depth as usize]), tile);
        }
    }

    /// A row for each candidate, a column for each depth.
    pub fn strip(&self) -> RgbImage {
        let mut rows: BTreeMap<u32, Vec<(String, RgbImage)>> = BTreeMap::new();
        for ((candidate, depth), tile) in &self.tiles {
            let row = rows.entry(*candidate).or_default();
            row.push((format!("{candidate}: +{depth}"), tile.clone()));
        }
        sheet(&rows.into_values().collect::<Vec<_>>())
    }

    /// A GIF file that shows each depth for as long as `period`, and then begins again.
    ///
    /// # Panics
    /// If a side has more than 65535 pixels, the most that the format has.
    pub fn film(&self, period: Duration) -> Vec<u8> {
        const WRITTEN: &str = "memory can be written, and the sides are short enough";
        let mut depths: BTreeMap<u32, Vec<(String, RgbImage)>> = BTreeMap::new();
        for ((candidate, depth), tile) in &self.tiles {
            let frame = depths.entry(*depth).or_default();
            frame.push((format!("{candidate}: +{depth}"), tile.clone()));
        }
        let mut file = Vec::new();
        let mut encoder = gif::GifEncoder::new_with_speed(&mut file, SPEED);
        encoder.set_repeat(gif::Repeat::Infinite).expect(WRITTEN);
        let last = depths.keys().next_back().copied();
        for (depth, tiles) in depths {
            let rest = if Some(depth) == last { REST } else { 1 };
            let delay = Delay::from_saturating_duration(period * rest);
            let rows: Vec<_> = tiles.chunks(COLUMNS).map(<[_]>::to_vec).collect();
            let picture = DynamicImage::ImageRgb8(sheet(&rows)).into_rgba8();
            encoder.encode_frame(Frame::from_parts(picture, 0, 0, delay)).expect(WRITTEN);
        }
        drop(encoder);
        file
    }
}

/// The objects of a row of a chunk, slot by slot; none where they did not come.
fn objects(chunk: &v1::RolloutChunk, at: u32, rows: u32) -> Vec<v1::Object> {
    let tracks = chunk.outputs.iter().find_map(|value| match value.value.as_ref()? {
        Value::Tracks(tracks) => Some(tracks),
        _ => None,
    });
    let Some((ids, values)) = tracks.and_then(|t| Some((t.ids.as_ref()?, t.values.as_ref()?)))
    else {
        return Vec::new();
    };
    let (ids, _) = ids.data.as_chunks::<8>();
    let (numbers, _) = values.data.as_chunks::<4>();
    let slots = ids.len() / rows as usize;
    let object = |slot: usize| {
        let of = at as usize * slots + slot;
        let number = |column: usize| f32::from_le_bytes(numbers[of * 6 + column]);
        Some(v1::Object {
            id: u64::try_from(i64::from_le_bytes(ids[of])).ok()?,
            slot: slot as u32,
            presence: number(0),
            x: number(1),
            y: number(2),
            width: number(3),
            height: number(4),
            depth: number(5),
            ..v1::Object::default()
        })
    };
    (0..slots).filter_map(object).collect()
}

#[cfg(test)]
mod tests {
    use image::{AnimationDecoder as _, Rgb};

    use super::*;

    fn pictures() -> Pictures {
        let mut pictures = Pictures::default();
        for (candidate, depth) in [(0, 1), (0, 2), (1, 2), (1, 1)] {
            let frames = v1::Tensor {
                dtype: v1::DataType::U8.into(),
                shape: vec![1, 1, 4, 4, 3],
                data: vec![(candidate * 100 + depth * 20) as u8; 48].into(),
                values: Vec::new(),
            };
            let value = v1::OutputValue {
                output: v1::Output::Frame.into(),
                value: Some(Value::Tensor(frames)),
            };
            let chunk = v1::RolloutChunk {
                first_candidate: candidate,
                candidates: 1,
                depths: vec![depth],
                outputs: vec![value],
                ..v1::RolloutChunk::default()
            };
            pictures.add(&chunk, 4);
        }
        pictures
    }

    #[test]
    fn a_strip_has_a_row_for_each_candidate() {
        let strip = pictures().strip();
        assert_eq!(strip.dimensions(), (6 + 2 * 22, 6 + 2 * 30));
        for grey in [20, 40, 120, 140] {
            let count = strip.pixels().filter(|pixel| **pixel == Rgb([grey; 3])).count();
            assert_eq!(count, 256, "{grey}");
        }
    }

    #[test]
    fn a_film_shows_one_depth_after_the_other() {
        let film = pictures().film(Duration::from_millis(200));
        let decoder = gif::GifDecoder::new(std::io::Cursor::new(film)).unwrap();
        let frames = decoder.into_frames().collect_frames().unwrap();
        let delays: Vec<u32> = frames.iter().map(|f| f.delay().numer_denom_ms().0).collect();
        assert_eq!(delays, [200, 800]);
        assert!(frames[1].buffer().pixels().any(|pixel| pixel.0 == [140, 140, 140, 255]));
    }
}
