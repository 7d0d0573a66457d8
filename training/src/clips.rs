//! Training data in memory: random crops of episodes as batches of tensors.

use std::ops::Range;

use anyhow::{Context as _, ensure};
use gatsbi_episodes::Dataset;
use gatsbi_models::{noise::philox4x32_10, world_model::ActionDimension};
use tch::{Device, Kind, Tensor};

use crate::evaluation::Recorded;

/// Levels (of 255) by which shadows darken a channel: their peak in the histogram is looked for here.
const SHADOWS: Range<usize> = 5..64;

/// A level that a pixel has this often, as a share of its most frequent one, is one that it returns to.
const LASTING: f64 = 0.25;

/// Levels (of 255) that the flank of a level's peak spans.
const FLANK: i64 = 6;

/// What is brighter than the background by more than this is no noise, in [0, 1].
const NOISE: f64 = 0.06;

/// Episodes as bytes, with what the trainer derives from them once.
#[derive(Debug)]
pub struct Clips {
    episodes: Vec<Episode>,
    /// The image behind all that moves, `[3, H, W]` in [0, 1]: the brightest level that each pixel returns to.
    pub background: Tensor,
    /// What is darker than the background by up to this counts as shadow, in [0, 1]; found in the data.
    pub shadow: f64,
    /// Scaling of the actions.
    pub actions: Vec<ActionDimension>,
    /// Seconds between frames.
    pub frame_period: f64,
    scale: Tensor,
}

#[derive(Debug)]
struct Episode {
    frames: Tensor,     // [T, 3, H, W] u8
    foreground: Tensor, // [T, H, W] u8
    motion: Tensor,     // [T, H, W] u8
    actions: Tensor,    // [T, A] raw
}

/// Where a sequence of a batch begins.
struct Crop<'a> {
    episode: &'a Episode,
    start: i64,
    /// Whether the first frame of an episode is one that no action led to.
    neutral: bool,
}

/// A batch of sequences.
#[derive(Debug)]
pub struct Batch {
    /// `[T]` frames of `[B, 3, H, W]` in [0, 1].
    pub frames: Vec<Tensor>,
    /// `[T]` scaled actions of `[B, A]`, each the one that led to its frame.
    pub actions: Vec<Tensor>,
    /// `[T]` maps of `[B, 1, H, W]` in [0, 1]: what differs from the background.
    pub foreground: Vec<Tensor>,
    /// `[T]` maps of `[B, 1, H, W]` in [0, 1]: what differs from the background and from the episode's median.
    pub motion: Vec<Tensor>,
}

impl Clips {
    /// Reads the episodes `range` of a data set. Its actions are scaled as they are told, else by their own spread.
    ///
    /// # Errors
    /// If an episode cannot be read, or the data set's actions are not those that are told.
    pub fn read(
        dataset: &Dataset,
        range: Range<usize>,
        scaling: Option<&[ActionDimension]>,
    ) -> anyhow::Result<Self> {
        let info = dataset.info();
        let (height, width) = (i64::from(info.height), i64::from(info.width));
        let mut read = Vec::new();
        for index in range {
            let episode = dataset.read(index).with_context(|| format!("episode {index}"))?;
            let data = episode.data();
            let length = i64::from(data.length);
            let frames = Tensor::from_slice(&data.rgb).view([length, height, width, 3]);
            let frames = frames.permute([0, 3, 1, 2]).contiguous();
            let actions =
                Tensor::from_slice(&data.actions).view([length, info.actions.len() as i64]);
            read.push((frames, actions));
        }
        let sample = sample(&read);
        let background = background(&sample);
        let shadow = shadow_threshold(&sample, &background);
        let episodes: Vec<Episode> = read
            .into_iter()
            .map(|(frames, actions)| {
                let own = frames.median_dim(0, false).0;
                let foreground = difference_map(&frames, &background, shadow);
                let motion = foreground.minimum(&difference_map(&frames, &own, shadow));
                Episode { frames, foreground, motion, actions }
            })
            .collect();
        let all = Tensor::cat(&episodes.iter().map(|e| &e.actions).collect::<Vec<_>>(), 0);
        // libtorch warns of the deviation of nothing.
        let std: Vec<f32> = match info.actions.as_slice() {
            [] => Vec::new(),
            _ => all.std_dim(Some([0i64].as_slice()), true, false).try_into()?,
        };
        let actions: Vec<ActionDimension> = info
            .actions
            .iter()
            .zip(&std)
            .map(|(dimension, std)| ActionDimension {
                name: dimension.name.clone(),
                unit: dimension.unit.clone(),
                offset: 0.0,
                // What never moved says nothing of its range.
                scale: if *std > 1e-6 { f64::from(*std) } else { 1.0 },
            })
            .collect();
        let actions = match scaling {
            None => actions,
            Some(told) => {
                let names = |actions: &[ActionDimension]| -> Vec<String> {
                    actions
                        .iter()
                        .map(|action| format!("{} ({})", action.name, action.unit))
                        .collect()
                };
                let (found, expected) = (names(&actions), names(told));
                ensure!(
                    found == expected,
                    "the data set's actions are {}, expected those of the checkpoint: {}",
                    found.join(", "),
                    expected.join(", ")
                );
                told.to_vec()
            }
        };
        let scale: Vec<f32> = actions.iter().map(|action| action.scale as f32).collect();
        Ok(Self {
            episodes,
            background: background / 255.0,
            shadow,
            actions,
            frame_period: info.frame_period_seconds,
            scale: Tensor::from_slice(&scale),
        })
    }

    /// Frames of the shortest episode.
    pub fn shortest(&self) -> i64 {
        self.episodes.iter().map(|episode| episode.frames.size()[0]).min().unwrap_or(0)
    }

    /// Number of episodes.
    pub fn len(&self) -> usize {
        self.episodes.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.episodes.is_empty()
    }

    /// The first `length` frames of episodes with raw actions, as an evaluation wants them.
    pub fn recorded(&self, episodes: &[usize], length: i64, device: Device) -> Recorded {
        let stack = |part: &dyn Fn(&Episode) -> Tensor| {
            let rows: Vec<Tensor> = episodes.iter().map(|&i| part(&self.episodes[i])).collect();
            Tensor::stack(&rows, 1).to_device(device).unbind(0) // [T][B, ...]
        };
        let frames = stack(&|e| e.frames.narrow(0, 0, length).to_kind(Kind::Float) / 255.0);
        let actions = stack(&|e| {
            let none = e.actions.narrow(0, 0, 1).zeros_like();
            Tensor::cat(&[none, e.actions.narrow(0, 0, length - 1)], 0)
        });
        Recorded { frames, actions, labels: None, contacts: None }
    }

    /// The batch of step `step`: a function of its arguments alone.
    pub fn batch(&self, seed: u64, step: u64, batch: i64, length: i64, device: Device) -> Batch {
        let key = [seed as u32, (seed >> 32) as u32];
        let row = |row| {
            let counter = [row as u32, 0x636c_6970, step as u32, (step >> 32) as u32];
            let [episode, start, neutral, _] = philox4x32_10(counter, key);
            let episode = &self.episodes[episode as usize % self.episodes.len()];
            let starts = episode.frames.size()[0] - length + 1;
            Crop { episode, start: i64::from(start) % starts, neutral: neutral % 2 == 0 }
        };
        let crops: Vec<Crop<'_>> = (0..batch).map(row).collect();
        self.stacked(&crops, length, device)
    }

    /// The first `length` frames of episodes, to which no action led.
    pub fn beginnings(&self, episodes: Range<usize>, length: i64, device: Device) -> Batch {
        let crop = |episode| Crop { episode, start: 0, neutral: true };
        let crops: Vec<Crop<'_>> = self.episodes[episodes].iter().map(crop).collect();
        self.stacked(&crops, length, device)
    }

    fn stacked(&self, crops: &[Crop<'_>], length: i64, device: Device) -> Batch {
        let stack = |part: &dyn Fn(&Episode) -> &Tensor| {
            let rows = crops.iter().map(|crop| part(crop.episode).narrow(0, crop.start, length));
            Tensor::stack(&rows.collect::<Vec<_>>(), 1).to_device(device) // [T, B, ...]
        };
        let image = |x: Tensor| x.to_kind(Kind::Float) / 255.0;
        let frames = image(stack(&|e| &e.frames));
        let map = |x: Tensor| image(x).unsqueeze(2).unbind(0);
        let foreground = map(stack(&|e| &e.foreground));
        let motion = map(stack(&|e| &e.motion));
        let actions: Vec<Tensor> = crops
            .iter()
            .map(|Crop { episode, start, neutral }| {
                let actions = &episode.actions;
                // Nothing led to the first frame of an episode: none, or the paper's convention.
                let first = match (*start, neutral) {
                    (0, true) => actions.narrow(0, 0, 1).zeros_like(),
                    (0, false) => actions.narrow(0, 0, 1),
                    (start, _) => actions.narrow(0, start - 1, 1),
                };
                Tensor::cat(&[first, actions.narrow(0, *start, length - 1)], 0)
            })
            .collect();
        let actions = (Tensor::stack(&actions, 1) / &self.scale).to_device(device);
        Batch { frames: frames.unbind(0), actions: actions.unbind(0), foreground, motion }
    }
}

/// Every sixth frame of about a hundred episodes, `[N, 3, H, W]` u8.
fn sample(episodes: &[(Tensor, Tensor)]) -> Tensor {
    let every = episodes.len().div_ceil(100).max(1);
    let sample: Vec<Tensor> = episodes
        .iter()
        .step_by(every)
        .map(|(frames, _)| frames.slice(0, 0, frames.size()[0], 6))
        .collect();
    Tensor::cat(&sample, 0)
}

/// The brightest level that every pixel of a sample `[N, 3, H, W]` returns to, `[3, H, W]` in [0, 255].
///
/// What moves passes a pixel with many levels; the background and the shadow on it come back. Shadows only darken, and
/// near where the robot rests they lie longer than not, so the most frequent level would keep them.
fn background(sample: &Tensor) -> Tensor {
    let size = sample.size();
    let pixels = sample.view([size[0], -1]).to_kind(Kind::Int64);
    let options = (Kind::Float, sample.device());
    let counts = Tensor::zeros([256, pixels.size()[1]], options).scatter_add_(
        0,
        &pixels,
        &Tensor::ones(pixels.size(), options),
    );
    // Twice over three levels: a triangle, so that a single level stays the top of its own peak.
    let smooth = |x: &Tensor| x.avg_pool1d([3], [1], [1], false, true);
    let near = smooth(&smooth(&counts.transpose(0, 1).unsqueeze(1))).squeeze_dim(1); // [3 H W, 256]
    let lasting = near.ge_tensor(&(near.amax(1, true) * LASTING)).to_kind(Kind::Int64);
    let levels = Tensor::arange(256, (Kind::Int64, sample.device()));
    let brightest = (lasting * &levels).amax(1, true);
    // The brightest lasting level is the upper flank of its peak; the background is the top.
    let flank = levels.le_tensor(&brightest).logical_and(&levels.gt_tensor(&(&brightest - FLANK)));
    let top = near.where_self(&flank, &near.zeros_like()).argmax(1, false);
    top.view(&size[1..]).to_kind(Kind::Float)
}

/// The foot behind the peak that shadows make in the histogram of darkening, in [0, 1].
/// Arm and objects darken by anything and make no peak of their own.
fn shadow_threshold(sample: &Tensor, background: &Tensor) -> f64 {
    let levels = differences(sample, background).0.clamp_min(0.0).round().to_kind(Kind::Int64);
    let counts = levels.flatten(0, -1).bincount::<Tensor>(None, 256).to_kind(Kind::Float);
    let counts: Vec<f32> = Vec::try_from(counts).expect("counts are one-dimensional");
    foot(&counts) as f64 / 255.0
}

/// The level where a histogram, smoothed over five levels, stops falling behind its highest peak in `SHADOWS`.
fn foot(counts: &[f32]) -> usize {
    let smooth = |level: usize| counts[level - 2..=level + 2].iter().sum::<f32>();
    let peak =
        SHADOWS.max_by(|a, b| smooth(*a).total_cmp(&smooth(*b))).expect("the levels are not empty");
    (peak..counts.len() - 3)
        .find(|level| smooth(level + 1) >= smooth(*level))
        .unwrap_or(counts.len() - 3)
}

/// By how much a channel of frames `[T, 3, H, W]` is darker, and brighter, than an image at most, `[T, H, W]` in
/// [-255, 255] each.
fn differences(frames: &Tensor, image: &Tensor) -> (Tensor, Tensor) {
    let brighter = frames.to_kind(Kind::Float) - image.to_kind(Kind::Float);
    ((-&brighter).amax(1, false), brighter.amax(1, false))
}

/// Where frames `[T, 3, H, W]` are brighter than an image, or darker than shadows make it, holes of a pixel filled,
/// `[T, H, W]` u8.
fn difference_map(frames: &Tensor, image: &Tensor, shadow: f64) -> Tensor {
    let (darker, brighter) = differences(frames, image);
    let dark = ((darker / 255.0 - shadow) * 40.0).sigmoid();
    let bright = ((brighter / 255.0 - NOISE) * 100.0).sigmoid();
    let map = dark.maximum(&bright).unsqueeze(1);
    let spread = |x: &Tensor| x.max_pool2d([3, 3], [1, 1], [1, 1], [1, 1], false);
    let closed = -spread(&-spread(&map));
    (closed.squeeze_dim(1) * 255.0).round().to_kind(Kind::Uint8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_brighter_is_foreground_and_a_shadow_is_not() {
        let image = Tensor::full([3, 3, 16], 120, (Kind::Uint8, Device::Cpu));
        let frame = image.shallow_clone().unsqueeze(0).copy();
        for (column, level) in [(2, 95), (8, 145), (13, 40)] {
            let _ = frame.narrow(3, column, 1).fill_(level);
        }
        let map = difference_map(&frame, &image, 0.15);
        let row: Vec<u8> = map.get(0).get(1).try_into().expect("one row");
        assert!(
            row[2] < 40 && row[8] > 245 && row[13] > 245 && row[5] < 10 && row[10] < 10,
            "{row:?}"
        );
    }

    #[test]
    fn neither_a_lasting_shadow_nor_what_passes_is_background() {
        let sample = Tensor::full([100, 3, 2, 2], 150, (Kind::Uint8, Device::Cpu));
        let _ = sample.narrow(0, 0, 60).fill_(120);
        for passing in 0..20 {
            let _ = sample.get(80 + passing).fill_(160 + passing * 4);
        }
        let found: Vec<f32> = background(&sample).flatten(0, -1).try_into().expect("levels");
        assert!(found.iter().all(|level| (level - 150.0).abs() < 1.0), "{found:?}");
    }

    #[test]
    fn the_shadow_threshold_is_the_foot_behind_the_shadows_peak() {
        // Noise at 0, shadows around 30, everything else flat.
        let counts: Vec<f32> = (0..256)
            .map(|level| {
                let bump = |at: f32, width: f32| (-((level as f32 - at) / width).powi(2)).exp();
                1e6 * bump(0.0, 1.5) + 1e5 * bump(30.0, 3.0) + 500.0 - level as f32 * 0.01
                    + if level >= 40 { 100.0 } else { 0.0 }
            })
            .collect();
        let foot = foot(&counts);
        assert!((36..=42).contains(&foot), "{foot}");
    }
}
