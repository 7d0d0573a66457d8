//! Makes data sets: episodes of a scene under its script, on several threads, into a folder that is whole at every
//! moment.
//!
//! An episode depends on the seed of the data set and its own index alone, and is written at its place in the order, so
//! threads change nothing but the time. What a folder holds already is not made again: that is how an interrupted run
//! goes on, and how a data set grows.

use std::{
    num::NonZeroUsize,
    path::Path,
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    thread,
};

use gatsbi_episodes::{
    ActionDimension, Dataset, DatasetInfo, DatasetWriter, Episode, LabelLegend, Manifest,
    Provenance, WriterOptions,
};
use serde_json::json;

use crate::{
    AGENT, BACKGROUND, Environment, Error, FIRST_OBJECT, Result, Scene, SceneSpec,
    recorder::Recorder, seeds::episode_seed,
};

/// Raised when the same seed no longer makes the same episodes.
const REVISION: u32 = 1;

/// Episodes that a thread may have ready before they are written.
const AHEAD: usize = 2;

/// What to make.
#[derive(Clone, Copy, Debug)]
pub struct Generation {
    /// Of which scene.
    pub scene: Scene,
    /// The data set gets the indices, which are also the ids, from 0 to one less than this.
    pub episodes: u64,
    /// Of the data set; the episodes' own follow from it.
    pub seed: u64,
    /// Height and width of the frames, pixels.
    pub size: u32,
    /// How many threads make episodes.
    pub threads: NonZeroUsize,
    /// A file is closed when it has grown to this many bytes; what is in the open one is lost if the run is killed.
    pub shard_bytes: usize,
}

/// Makes the episodes that `out` does not hold yet. `progress` is told how many there are and shall be.
///
/// # Errors
/// [`Error::OtherDataset`] if the folder holds something else; those of the scene and of the disk. Episodes that were
/// written before the error stay.
pub fn generate(
    generation: &Generation,
    out: &Path,
    mut progress: impl FnMut(u64, u64),
) -> Result<Manifest> {
    // Opened here too, so that what is missing is said once and at once.
    let info = dataset_info(generation, generation.scene.open(generation.size)?.spec());
    let options = WriterOptions { shard_bytes: generation.shard_bytes, ..WriterOptions::default() };
    let mut writer = open(out, info, options)?;
    let missing: Vec<u64> =
        (0..generation.episodes).filter(|&index| !writer.contains(index)).collect();
    let mut done = generation.episodes - missing.len() as u64;
    progress(done, generation.episodes);
    let threads = generation.threads.get().min(missing.len());
    let info = writer.info().clone();
    thread::scope(|scope| -> Result<()> {
        let (mut receivers, mut workers) = (Vec::new(), Vec::new());
        for worker in 0..threads {
            let (sender, receiver) = sync_channel(AHEAD);
            let (mine, info) = (missing.iter().copied().skip(worker).step_by(threads), &info);
            let work = move || make(generation, info, mine, &sender);
            let thread = thread::Builder::new().name(format!("episodes-{worker}"));
            workers.push(thread.spawn_scoped(scope, work)?);
            receivers.push(receiver);
        }
        let mut write = |receiver: &Receiver<Result<Episode>>| -> Result<()> {
            writer.write(&receiver.recv().map_err(|_gone| Error::Panicked)??)?;
            done += 1;
            progress(done, generation.episodes);
            Ok(())
        };
        let written = receivers.iter().cycle().take(missing.len()).try_for_each(&mut write);
        drop(receivers);
        // One that panicked is told of by then; left to the scope, it would panic once more.
        for worker in workers {
            worker.join().ok();
        }
        written
    })?;
    Ok(writer.finish()?)
}

/// Makes the episodes of these indices, until nobody wants them any more.
fn make(
    generation: &Generation,
    info: &DatasetInfo,
    indices: impl Iterator<Item = u64>,
    sender: &SyncSender<Result<Episode>>,
) {
    let mut scene = match generation.scene.open(generation.size) {
        Ok(scene) => scene,
        Err(error) => {
            sender.send(Err(error)).ok();
            return;
        }
    };
    for index in indices {
        let episode = record(scene.as_mut(), info, index, episode_seed(generation.seed, index));
        if sender.send(episode).is_err() {
            return;
        }
    }
}

/// Plays one episode under the script and keeps all of it.
pub fn record(
    scene: &mut dyn Environment,
    info: &DatasetInfo,
    index: u64,
    seed: u64,
) -> Result<Episode> {
    let frames = scene.spec().frames;
    let mut recorder = Recorder::new(index, seed);
    let mut seen = scene.reset(seed)?;
    for frame in 0..frames {
        let action = scene.scripted_action()?;
        recorder.add(&seen, &action);
        // The last action is held after the last frame: nobody sees what it does.
        if frame + 1 < frames {
            seen = scene.step(&action)?;
        }
    }
    Episode::new(recorder.finish(), info).map_err(|source| Error::Episode { index, source })
}

/// The description of the data set that a generation makes.
pub fn dataset_info(generation: &Generation, spec: &SceneSpec) -> DatasetInfo {
    let parameters = json!({
        "scene": spec.scene,
        "seed": generation.seed,
        "revision": REVISION,
        "physics": generation.scene.physics(),
    });
    DatasetInfo {
        name: spec.scene.into(),
        height: spec.size,
        width: spec.size,
        channels: 3,
        frame_period_seconds: spec.frame_period_seconds,
        actions: spec
            .actions
            .iter()
            .map(|action| ActionDimension { name: action.name.clone(), unit: action.unit.into() })
            .collect(),
        labels: Some(LabelLegend {
            background: BACKGROUND,
            agent: AGENT,
            first_object: FIRST_OBJECT,
        }),
        provenance: Some(Provenance {
            generator: env!("CARGO_PKG_NAME").into(),
            version: Some(env!("CARGO_PKG_VERSION").into()),
            source: None,
            parameters: parameters.as_object().cloned().unwrap_or_default().into_iter().collect(),
        }),
    }
}

/// Starts the folder, or goes on with it if it holds the same data set.
fn open(out: &Path, info: DatasetInfo, options: WriterOptions) -> Result<DatasetWriter> {
    let is_started = out.join("manifest.json").exists();
    if !is_started {
        return Ok(DatasetWriter::create(out, info, options)?);
    }
    if let Some((what, found, expected)) = Dataset::open(out)?.info().difference(&info) {
        return Err(Error::OtherDataset { path: out.into(), what, found, expected });
    }
    Ok(DatasetWriter::append(out, options)?)
}
