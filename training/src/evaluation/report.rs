//! The evaluation of a checkpoint on a data set, as numbers.

use std::{
    collections::{BTreeMap, HashMap},
    ops::Range,
};

use gatsbi_episodes::Dataset;
use gatsbi_models::{
    scene::{Output, Outputs, Scene},
    world_model::WorldModel,
};
use serde::Serialize;
use tch::Tensor;

use super::{
    CONDITIONING, Draw, Recorded, decomposition, images,
    interaction::Followed,
    motion::{Motion, Starts},
    perceptual::{Perceptual, frechet_distance},
    rollout,
    statistics::{Estimate, PerEpisode},
    wanted,
};

/// Imagined steps from which swapped actions are expected to show.
const ACTIONS_MATTER_FROM: usize = 5;

/// Seed of sampled rollouts; the number of the episode is added.
const SEED: u64 = 0x6761_7473_6269;

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
    /// Sampled rollouts of each episode.
    pub samples: u32,
    /// Numbers by name; `NAME_ci95` is half the width of the 95 % interval over episodes, where there is one.
    pub numbers: BTreeMap<String, f64>,
    /// Image metrics per imagined step, of the model and of copying the last observed frame.
    pub per_step: Vec<BTreeMap<String, f64>>,
}

impl Report {
    /// The numbers of each imagined step, a line a step, with a header.
    pub fn csv(&self) -> String {
        let names: Vec<&str> = match self.per_step.first() {
            Some(first) => first.keys().map(String::as_str).collect(),
            None => Vec::new(),
        };
        let mut lines = vec![format!("step,{}", names.join(","))];
        for (step, numbers) in self.per_step.iter().enumerate() {
            let values: Vec<String> = numbers.values().map(f64::to_string).collect();
            lines.push(format!("{},{}", step + 1, values.join(",")));
        }
        lines.join("\n") + "\n"
    }

    fn insert(&mut self, name: &str, Estimate { mean, ci95 }: Estimate) {
        self.numbers.insert(name.to_owned(), mean);
        self.numbers.insert(format!("{name}_ci95"), ci95);
    }
}

/// How a model is measured.
#[derive(Clone, Copy, Debug)]
pub struct Protocol<'a> {
    /// Imagined steps.
    pub horizon: usize,
    /// Sampled rollouts of which the best counts, metric by metric; none without it.
    pub samples: u32,
    /// Networks of the perceptual metrics, if those are wanted.
    pub perceptual: Option<&'a Perceptual>,
}

/// Features of videos: the recorded ones, the imagined, and a copy of the last observed frame.
#[derive(Default)]
struct Videos([Vec<Tensor>; 3]);

impl Videos {
    /// Adds the clips from the last observed frame on.
    fn add(&mut self, perceptual: &Perceptual, recorded: &Recorded, scenes: &[Scene]) {
        let last = CONDITIONING - 1;
        let start = &recorded.frames[last];
        let imagined = scenes[CONDITIONING..].iter().map(image);
        let clips = [
            recorded.frames[last..].iter().map(Tensor::shallow_clone).collect::<Vec<_>>(),
            std::iter::once(start.shallow_clone()).chain(imagined).collect(),
            recorded.frames[last..].iter().map(|_| start.shallow_clone()).collect(),
        ];
        for (features, clip) in self.0.iter_mut().zip(clips) {
            features.push(perceptual.video_features(&Tensor::stack(&clip, 2)));
        }
    }

    /// Fréchet distances to the recorded videos: imagined, copied.
    fn distances(&self) -> [f64; 2] {
        let [truth, imagined, copied] = self.0.each_ref().map(|features| Tensor::cat(features, 0));
        [frechet_distance(&imagined, &truth), frechet_distance(&copied, &truth)]
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

/// Measures a model: five frames observed, the horizon imagined with means (and with samples, of which the best
/// counts), against the recorded future.
///
/// # Errors
/// If episodes cannot be read or are shorter than that.
pub fn report(
    world: &dyn WorldModel,
    dataset: &Dataset,
    range: Range<usize>,
    protocol: Protocol<'_>,
    mut progress: impl FnMut(usize),
) -> anyhow::Result<Report> {
    let spec = world.spec();
    let Protocol { horizon, samples, perceptual } = protocol;
    let length = CONDITIONING + horizon;
    let neutral = spec.neutral_action();
    let mut tally = Tally { steps: vec![BTreeMap::new(); horizon], ..Tally::default() };
    let mut videos = Videos::default();
    let indices: Vec<usize> = range.clone().collect();
    for (chunk, episodes) in indices.chunks(BATCH).enumerate() {
        let recorded = Recorded::read(dataset, episodes, length, &neutral, world.device())?;
        let scenes =
            rollout(world, &recorded, CONDITIONING, &recorded.actions, Draw::Mean, wanted());
        let swapped = swapped_actions(&recorded);
        let only_frames = Outputs::from_iter([Output::Frame]);
        let only_objects = Outputs::from_iter([Output::Objects]);
        let seen = rollout(world, &recorded, length, &recorded.actions, Draw::Mean, only_objects);
        let others = rollout(world, &recorded, CONDITIONING, &swapped, Draw::Mean, only_frames);
        let first_episode = chunk * BATCH;
        let mut identities = HashMap::new();
        let (mut followed, mut starts) = (Vec::new(), Vec::new());
        for t in 0..length {
            let at = At { t, first_episode };
            add_images(&mut tally, &recorded, &scenes, &others, at);
            if let Some(perceptual) = perceptual {
                add_perceptual(&mut tally, perceptual, &recorded, &scenes, at);
            }
            if let Some(labels) = &recorded.labels {
                let labels = |row: usize| labels[t].get(row as i64);
                let matches =
                    add_decomposition(&mut tally, &recorded, &scenes[t], spec, at, &mut identities);
                if t + 1 == CONDITIONING {
                    followed = matches.iter().map(|matches| Followed::new(matches)).collect();
                    let start = |(row, matches): (usize, &Vec<_>)| {
                        Starts::new(matches, &scenes[t], &labels(row), row as i64)
                    };
                    starts = matches.iter().enumerate().map(start).collect();
                } else if t >= CONDITIONING {
                    for (row, starts) in starts.iter().enumerate() {
                        let step =
                            |scenes: &[Scene]| starts.step(&scenes[t], &labels(row), row as i64);
                        let episode = first_episode + row;
                        add_motion(&mut tally, episode, "imagined", step(&scenes));
                        add_motion(&mut tally, episode, "observed", step(&seen));
                    }
                    add_interactions(&mut tally, &recorded, &scenes[t], at, &mut followed);
                }
            }
        }
        let sampled: Vec<Vec<Scene>> = (0..samples)
            .map(|sample| {
                let draw = Draw::Sample { seed: SEED + episodes[0] as u64, sample };
                rollout(world, &recorded, CONDITIONING, &recorded.actions, draw, only_frames)
            })
            .collect();
        add_best(&mut tally, &recorded, &sampled, first_episode);
        if let Some(perceptual) = perceptual {
            videos.add(perceptual, &recorded, &scenes);
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
        samples,
        ..Report::default()
    };
    for (name, numbers) in &tally.averages {
        report.insert(name, numbers.estimate());
    }
    for (name, numbers) in &tally.ratios {
        report.insert(name, numbers.pooled());
    }
    if perceptual.is_some() {
        let [imagined, copied] = videos.distances();
        report.numbers.insert("fvd_imagined".to_owned(), imagined);
        report.numbers.insert("fvd_copy".to_owned(), copied);
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

/// How far moved objects are followed: in `phase`, while the frames since the start were imagined or observed.
fn add_motion(tally: &mut Tally, episode: usize, phase: &str, motion: Motion) {
    let Motion { moved, kept, error, still, way } = motion;
    let mut ratio = |name: &str, numerator, denominator| {
        tally.ratio(&format!("moved_object_{name}_{phase}"), episode, numerator, denominator);
    };
    ratio("px", error, kept as f64);
    ratio("px_still", still, kept as f64);
    ratio("way", way, still);
    ratio("kept", kept as f64, moved as f64);
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

/// The drawn frame, `[B, 3, H, W]` in [0, 1].
fn image(scene: &Scene) -> Tensor {
    scene.frame.as_ref().expect("the frame was asked for").clamp(0.0, 1.0)
}

fn add_perceptual(
    tally: &mut Tally,
    perceptual: &Perceptual,
    recorded: &Recorded,
    scenes: &[Scene],
    at: At,
) {
    let Some(step) = at.t.checked_sub(CONDITIONING) else { return };
    let truth = &recorded.frames[at.t];
    let own = perceptual.st_lpips(&image(&scenes[at.t]), truth);
    let copies = perceptual.st_lpips(&recorded.frames[CONDITIONING - 1], truth);
    for (row, (own, copied)) in own.into_iter().zip(copies).enumerate() {
        let episode = at.first_episode + row;
        for (name, value) in [("st_lpips", own), ("st_lpips_copy", copied)] {
            tally.steps[step].entry(name.to_owned()).or_default().add(episode, value);
        }
        tally.average("st_lpips_imagined", episode, own);
        tally.average("st_lpips_copy", episode, copied);
    }
}

/// Each metric's best sampled rollout, by its mean over imagined steps.
fn add_best(tally: &mut Tally, recorded: &Recorded, sampled: &[Vec<Scene>], first_episode: usize) {
    let mut best: Vec<[f64; 4]> = Vec::new();
    for scenes in sampled {
        let imagined = &scenes[CONDITIONING..];
        let mut means = vec![[0.0; 4]; recorded.frames[0].size()[0] as usize];
        for (scene, truth) in imagined.iter().zip(&recorded.frames[CONDITIONING..]) {
            for (mean, metrics) in means.iter_mut().zip(images::all(&image(scene), truth)) {
                for (mean, metric) in mean.iter_mut().zip(metrics) {
                    *mean += metric / imagined.len() as f64;
                }
            }
        }
        if best.is_empty() {
            best.clone_from(&means);
        }
        for (best, mean) in best.iter_mut().zip(&means) {
            for (metric, name) in images::NAMES.iter().enumerate() {
                let lower_is_better = *name == "mse";
                if (mean[metric] < best[metric]) == lower_is_better {
                    best[metric] = mean[metric];
                }
            }
        }
    }
    for (row, metrics) in best.iter().enumerate() {
        for (name, value) in images::NAMES.iter().zip(metrics) {
            tally.average(&format!("{name}_best"), first_episode + row, *value);
        }
    }
}

fn add_images(tally: &mut Tally, recorded: &Recorded, scenes: &[Scene], others: &[Scene], at: At) {
    let truth = &recorded.frames[at.t];
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

/// Returns the `(label, identity)` pairs of every row.
fn add_decomposition(
    tally: &mut Tally,
    recorded: &Recorded,
    scene: &Scene,
    spec: &gatsbi_models::world_model::ModelSpec,
    at: At,
    identities: &mut HashMap<(usize, i64), i64>,
) -> Vec<Vec<(i64, i64)>> {
    let mut pairs = Vec::new();
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
        let (counts, matches) = decomposition::match_objects(scene, labels, row as i64);
        let matched = counts.matched as f64;
        let suffix = if at.t < CONDITIONING { "" } else { "_imagined" };
        let mut ratio = |name: &str, numerator: f64, denominator: usize| {
            tally.ratio(&format!("{name}{suffix}"), episode, numerator, denominator as f64);
        };
        ratio("object_recall", matched, counts.truth);
        ratio("object_precision", matched, counts.found);
        ratio("object_position_px", counts.distance, counts.matched);
        for &(label, id) in &matches {
            if let Some(before) = identities.insert((episode, label), id) {
                ratio("identity_switches", f64::from(u8::from(before != id)), 1);
            }
        }
        pairs.push(matches);
    }
    pairs
}

/// Position errors of followed objects, before and after something touched them.
fn add_interactions(
    tally: &mut Tally,
    recorded: &Recorded,
    scene: &Scene,
    at: At,
    followed: &mut [Followed],
) {
    let (Some(contacts), Some(labels)) = (&recorded.contacts, &recorded.labels) else { return };
    for (row, (followed, contacts)) in followed.iter_mut().zip(contacts).enumerate() {
        let labels = labels[at.t].get(row as i64);
        let distances = followed.step(at.t, contacts, scene, &labels, row as i64);
        for (name, distances) in [
            ("object_px_before_interaction", distances.before),
            ("object_px_after_interaction", distances.after),
        ] {
            let sum: f64 = distances.iter().sum();
            tally.ratio(name, at.first_episode + row, sum, distances.len() as f64);
        }
    }
}
