//! The evaluation of a checkpoint on a data set, as numbers.

use std::{collections::BTreeMap, ops::Range};

use gatsbi_episodes::Dataset;
use gatsbi_models::{scene::Scene, world_model::WorldModel};
use serde::Serialize;
use tch::Tensor;

use super::{
    CONDITIONING, Recorded, decomposition, images, rollout,
    statistics::{Estimate, PerEpisode},
    wanted,
};

/// Imagined steps from which swapped actions are expected to show.
const ACTIONS_MATTER_FROM: usize = 5;

/// Episodes that are rolled out together.
const BATCH: usize = 10;

/// Everything measured; the keys are those of the JSON.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Report {
    /// Checkpoint's name, hash and training steps.
    pub model: BTreeMap<&'static str, String>,
    /// Data set and episodes.
    pub data: String,
    /// Episodes measured.
    pub episodes: usize,
    /// Imagined steps.
    pub horizon: usize,
    /// Numbers by name; `NAME_ci95` is half the width of the 95 % interval over episodes.
    pub numbers: BTreeMap<String, f64>,
    /// Image metrics per imagined step, of the model and of copying the last observed frame.
    pub per_step: Vec<BTreeMap<String, f64>>,
}

impl Report {
    fn insert(&mut self, name: &str, Estimate { mean, ci95 }: Estimate) {
        self.numbers.insert(name.to_owned(), mean);
        self.numbers.insert(format!("{name}_ci95"), ci95);
    }
}

/// Numbers on their way to a report.
#[derive(Default)]
struct Tally {
    averages: BTreeMap<String, PerEpisode>,
    ratios: BTreeMap<String, PerEpisode>,
    steps: Vec<BTreeMap<String, PerEpisode>>,
}

impl Tally {
    fn average(&mut self, name: &str, episode: usize, value: f64) {
        self.averages.entry(name.to_owned()).or_default().add(episode, value);
    }

    fn ratio(&mut self, name: &str, episode: usize, numerator: f64, denominator: f64) {
        self.ratios.entry(name.to_owned()).or_default().add_ratio(episode, numerator, denominator);
    }
}

/// Measures a model: five frames observed, `horizon` imagined with means, against the recorded future.
///
/// # Errors
/// If episodes cannot be read or are shorter than that.
pub fn report(
    world: &dyn WorldModel,
    dataset: &Dataset,
    range: Range<usize>,
    horizon: usize,
    mut progress: impl FnMut(usize),
) -> anyhow::Result<Report> {
    let spec = world.spec();
    let length = CONDITIONING + horizon;
    let neutral = spec.neutral_action();
    let mut tally = Tally { steps: vec![BTreeMap::new(); horizon], ..Tally::default() };
    let indices: Vec<usize> = range.clone().collect();
    for (chunk, episodes) in indices.chunks(BATCH).enumerate() {
        let recorded = Recorded::read(dataset, episodes, length, &neutral, world.device())?;
        let scenes = rollout(world, &recorded, &recorded.actions, wanted());
        let swapped = swapped_actions(&recorded);
        let others = rollout(world, &recorded, &swapped, wanted());
        for t in 0..length {
            let at = At { t, first_episode: chunk * BATCH };
            add_images(&mut tally, &recorded, &scenes, &others, at);
            if recorded.labels.is_some() {
                add_decomposition(&mut tally, &recorded, &scenes[t], spec, at);
            }
        }
        progress(episodes.len());
    }
    let mut report = Report {
        model: BTreeMap::from([
            ("name", spec.name.clone()),
            ("hash", spec.hash.clone()),
            ("trained_steps", spec.trained_steps.to_string()),
        ]),
        data: format!("{} episodes {}..{}", dataset.info().name, range.start, range.end),
        episodes: indices.len(),
        horizon,
        ..Report::default()
    };
    for (name, numbers) in &tally.averages {
        report.insert(name, numbers.estimate());
    }
    for (name, numbers) in &tally.ratios {
        report.insert(name, numbers.pooled());
    }
    report.per_step = tally
        .steps
        .iter()
        .map(|step| {
            step.iter().map(|(name, numbers)| (name.clone(), numbers.estimate().mean)).collect()
        })
        .collect();
    Ok(report)
}

/// Where in the evaluation a frame is.
#[derive(Clone, Copy)]
struct At {
    t: usize,
    first_episode: usize,
}

impl At {
    fn phase(self) -> &'static str {
        if self.t < CONDITIONING { "observed" } else { "imagined" }
    }
}

/// Each episode gets its neighbour's actions from the first imagined step on.
fn swapped_actions(recorded: &Recorded) -> Vec<Tensor> {
    let swap = |(t, action): (usize, &Tensor)| {
        if t < CONDITIONING {
            action.shallow_clone()
        } else {
            action.roll([1i64].as_slice(), [0i64].as_slice())
        }
    };
    recorded.actions.iter().enumerate().map(swap).collect()
}

fn add_images(tally: &mut Tally, recorded: &Recorded, scenes: &[Scene], others: &[Scene], at: At) {
    let truth = &recorded.frames[at.t];
    let image =
        |scene: &Scene| scene.frame.as_ref().expect("the frame was asked for").clamp(0.0, 1.0);
    let own = images::all(&image(&scenes[at.t]), truth);
    let phase = at.phase();
    for (row, metrics) in own.iter().enumerate() {
        for (name, value) in images::NAMES.iter().zip(metrics) {
            tally.average(&format!("{name}_{phase}"), at.first_episode + row, *value);
        }
    }
    let Some(step) = at.t.checked_sub(CONDITIONING) else { return };
    let copies = images::all(&recorded.frames[CONDITIONING - 1], truth);
    let swapped = images::psnr(&image(&others[at.t]), truth);
    for (row, (metrics, copy)) in own.iter().zip(&copies).enumerate() {
        let episode = at.first_episode + row;
        for ((name, value), copied) in images::NAMES.iter().zip(metrics).zip(copy) {
            tally.average(&format!("{name}_copy"), episode, *copied);
            let step = &mut tally.steps[step];
            step.entry((*name).to_owned()).or_default().add(episode, *value);
            step.entry(format!("{name}_copy")).or_default().add(episode, *copied);
        }
        tally.average("psnr_gain_over_copy_db", episode, metrics[0] - copy[0]);
        if step + 1 >= ACTIONS_MATTER_FROM {
            tally.average("action_psnr_gain_db", episode, metrics[0] - swapped[row]);
        }
    }
}

fn add_decomposition(
    tally: &mut Tally,
    recorded: &Recorded,
    scene: &Scene,
    spec: &gatsbi_models::world_model::ModelSpec,
    at: At,
) {
    let labels = &recorded.labels.as_ref().expect("the caller checked")[at.t];
    let segmentation = decomposition::segmentation(scene);
    let phase = at.phase();
    let is_agent = match spec.agent_slot {
        Some(slot) => segmentation.eq(slot),
        None => segmentation.eq(-1),
    };
    let is_background = segmentation.lt(spec.slots).logical_and(&is_agent.logical_not());
    let agent = decomposition::iou(&is_agent, &labels.eq(1));
    let background = decomposition::iou(&is_background, &labels.eq(0));
    for (row, (agent, background)) in agent.iter().zip(&background).enumerate() {
        let episode = at.first_episode + row;
        if spec.agent_slot.is_some() {
            tally.average(&format!("agent_iou_{phase}"), episode, *agent);
        }
        tally.average(&format!("background_iou_{phase}"), episode, *background);
        let entities = decomposition::entities(&segmentation, &is_background, row as i64);
        let ari = decomposition::adjusted_rand_index(&entities, &labels.get(row as i64));
        tally.average(&format!("ari_{phase}"), episode, ari);
        let (counts, _) = decomposition::match_objects(scene, labels, row as i64);
        let matched = counts.matched as f64;
        let suffix = if at.t < CONDITIONING { "" } else { "_imagined" };
        let mut ratio = |name: &str, numerator: f64, denominator: usize| {
            tally.ratio(&format!("{name}{suffix}"), episode, numerator, denominator as f64);
        };
        ratio("object_recall", matched, counts.truth);
        ratio("object_precision", matched, counts.found);
        ratio("object_position_px", counts.distance, counts.matched);
    }
}
