//! Evaluation: five frames observed, then imagination, against the recorded future and its ground truth.

pub mod decomposition;
pub mod images;
pub mod interaction;
pub mod motion;
pub mod perceptual;
pub mod picture;
pub mod plot;
pub mod report;
#[cfg(test)]
mod samples;
pub mod statistics;

use anyhow::Context as _;
use gatsbi_episodes::{Dataset, Episode};
use gatsbi_models::{
    noise::{PhiloxNoise, RowNoise},
    scene::{Output, Outputs, Scene},
    world_model::WorldModel,
};
use tch::{Device, Kind, Tensor};

use interaction::Contacts;

/// Frames that are observed before imagining starts (paper's protocol).
pub const CONDITIONING: usize = 5;

/// Episodes as a batch, cut to the same length.
#[derive(Debug)]
pub struct Recorded {
    /// `[T]` frames of `[B, 3, H, W]` in [0, 1].
    pub frames: Vec<Tensor>,
    /// `[T]` raw actions of `[B, A]`: `actions[t]` led to frame t, the first is neutral.
    pub actions: Vec<Tensor>,
    /// `[T]` labels of `[B, H, W]` int64, where the data has them.
    pub labels: Option<Vec<Tensor>>,
    /// `[B]`, what touched what, where the data says it.
    pub contacts: Option<Vec<Contacts>>,
}

impl Recorded {
    /// The first `length` frames of episodes.
    pub fn read(
        dataset: &Dataset,
        episodes: &[usize],
        length: usize,
        neutral: &[f32],
        device: Device,
    ) -> anyhow::Result<Self> {
        let read: Vec<Episode> = episodes
            .iter()
            .map(|&index| dataset.read(index).with_context(|| format!("episode {index}")))
            .collect::<Result<_, _>>()?;
        let info = dataset.info();
        let (height, width) = (i64::from(info.height), i64::from(info.width));
        let per_frame = |part: &dyn Fn(&Episode, usize) -> Tensor| -> Vec<Tensor> {
            (0..length)
                .map(|t| {
                    let rows: Vec<Tensor> = read.iter().map(|e| part(e, t)).collect();
                    Tensor::stack(&rows, 0).to_device(device)
                })
                .collect()
        };
        let frames = per_frame(&|e, t| {
            let frame = Tensor::from_slice(e.frame(t)).view([height, width, 3]);
            frame.permute([2, 0, 1]).to_kind(Kind::Float) / 255.0
        });
        let actions = per_frame(&|e, t| match t.checked_sub(1) {
            Some(before) => Tensor::from_slice(e.action(before)),
            None => Tensor::from_slice(neutral),
        });
        let labelled = read.iter().all(|e| e.mask(0).is_some());
        let labels = labelled.then(|| {
            per_frame(&|e, t| {
                let mask = e.mask(t).expect("every episode has masks");
                Tensor::from_slice(mask).view([height, width]).to_kind(Kind::Int64)
            })
        });
        let contacts = read.iter().map(Contacts::of).collect();
        Ok(Self { frames, actions, labels, contacts })
    }
}

/// What latents are drawn with.
#[derive(Clone, Copy, Debug)]
pub enum Draw {
    /// Means of all distributions.
    Mean,
    /// One of several samples; rows of a batch have seeds of their own, from `seed` on.
    Sample {
        /// Seed of the first row.
        seed: u64,
        /// Index of the sample.
        sample: u32,
    },
}

impl Draw {
    fn noise(self, batch: i64, t: usize, device: Device) -> PhiloxNoise {
        match self {
            Self::Mean => PhiloxNoise::mean(batch, device),
            Self::Sample { seed, sample } => {
                let row = |row| RowNoise::Sample { seed: seed + row, sample, step: t as u64 };
                PhiloxNoise::new((0..batch as u64).map(row).collect(), device)
            }
        }
    }
}

/// Observes the first `observed` frames and imagines the rest, with `actions` from then on.
pub fn rollout(
    world: &dyn WorldModel,
    recorded: &Recorded,
    observed: usize,
    actions: &[Tensor],
    draw: Draw,
    wanted: Outputs,
) -> Vec<Scene> {
    let batch = recorded.frames[0].size()[0];
    let mut state = world.initial_state(batch);
    let mut scenes = Vec::new();
    for (t, action) in actions.iter().enumerate() {
        let noise = draw.noise(batch, t, world.device());
        let (next, scene) = if t < observed {
            world.observe(&state, Some(&recorded.frames[t]), action, &noise, wanted)
        } else {
            world.imagine(&state, action, &noise, wanted)
        };
        state = next;
        scenes.push(scene);
    }
    scenes
}

/// What the evaluation asks a model for.
pub fn wanted() -> Outputs {
    Outputs::from_iter([
        Output::Frame,
        Output::SlotMasks,
        Output::ObjectMasks,
        Output::Objects,
        Output::Background,
    ])
}
