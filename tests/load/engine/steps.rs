//! Steps of a frozen model on one thread, beside its twin's (`tests/reference/gatsbi_twin/timing.py`).
//!
//! Each line `CHECKPOINT BATCH STEP SECONDS` has a step (`observe`, `imagine` or `train`) repeated for so long, at least once, and
//! is answered by how often it was made, the multiply-accumulates of one, and, but for `train`, the bytes of a row's state; whoever asks
//! looks at the processor time meanwhile. Steps are those that a server makes: packed state, actions in raw units,
//! counter-based noise, new objects looked for in every frame, nothing drawn. `train` is what an optimiser's step needs: the
//! loss of a sequence of [`SEQUENCE`] frames, every network but the keypoints' in it, and its gradients. The step `multiply` is a product of square
//! matrices, as fast as libtorch makes one: what the processor can do.

use std::{
    collections::{HashMap, hash_map::Entry},
    path::Path,
    time::{Duration, Instant},
};

use anyhow::{Result, bail};
use gatsbi_models::{
    checkpoint::Checkpoint,
    gatsbi::{
        loss,
        model::{GradientStops, Observing},
        objects::Discover,
        world::GatsbiWorld,
    },
    nn::count_macs,
    noise::{PhiloxNoise, RowNoise},
    scene::Outputs,
    state::State,
    world_model::WorldModel,
};
use tch::{Device, Kind, Tensor};

/// Rows of the matrices that are multiplied: large enough for full speed, small enough for a turn.
const SIDE: u64 = 1024;

/// Frames of a sequence that is trained on.
const SEQUENCE: u64 = 4;

/// Standard deviation of the image likelihood.
const SIGMA: f64 = 0.1;

/// Batches that have been asked for, by checkpoint and rows.
pub(crate) struct Steps {
    batches: HashMap<(String, i64), Batch>,
    sequences: HashMap<(String, i64), Sequence>,
    square: Tensor,
}

/// A batch of a model in the midst of its scenes.
struct Batch {
    world: GatsbiWorld,
    state: State,
    frame: Tensor,
    action: Tensor,
    noise: PhiloxNoise,
}

impl Steps {
    pub(crate) fn new() -> Self {
        tch::set_num_threads(1);
        tch::set_num_interop_threads(1);
        let square = Tensor::rand([SIDE as i64; 2], (Kind::Float, Device::Cpu));
        Self { batches: HashMap::new(), sequences: HashMap::new(), square }
    }

    /// Measures what a line asks for; returns its numbers.
    pub(crate) fn measure(&mut self, line: &str) -> Result<String> {
        let &[checkpoint, rows, step, seconds] = &line.split(' ').collect::<Vec<_>>()[..] else {
            bail!("{line:?} is not CHECKPOINT BATCH STEP SECONDS");
        };
        let rows: i64 = rows.parse()?;
        let time = Duration::from_secs_f64(seconds.parse()?);
        if step == "train" {
            let sequence = match self.sequences.entry((checkpoint.to_owned(), rows)) {
                Entry::Occupied(there) => there.into_mut(),
                Entry::Vacant(new) => new.insert(Sequence::new(Path::new(checkpoint), rows)?),
            };
            let (made, macs) = repeat(time, || sequence.train());
            return Ok(format!("{made} {macs}"));
        }
        let batch = match self.batches.entry((checkpoint.to_owned(), rows)) {
            Entry::Occupied(there) => there.into_mut(),
            Entry::Vacant(new) => new.insert(Batch::new(Path::new(checkpoint), rows)?),
        };
        let (made, macs) = match step {
            "observe" => repeat(time, || batch.observe()),
            "imagine" => repeat(time, || batch.imagine()),
            "multiply" => {
                let (made, _) = repeat(time, || self.square.matmul(&self.square));
                (made, SIDE.pow(3))
            }
            _ => bail!("{step:?} is not observe, imagine, train or multiply"),
        };
        Ok(format!("{made} {macs} {}", batch.world.layout().row_bytes()))
    }
}

impl Batch {
    /// A batch that has observed one frame and, to be warm, imagined one step.
    fn new(checkpoint: &Path, rows: i64) -> Result<Self> {
        let device = Device::Cpu;
        let world = GatsbiWorld::load(checkpoint, device)?;
        let spec = world.spec();
        let size = spec.image_size;
        let frame = Tensor::rand([rows, 3, size, size], (Kind::Float, device));
        let action = Tensor::randn([rows, spec.actions.len() as i64], (Kind::Float, device));
        let row = |row| RowNoise::Sample { seed: row, sample: 0, step: 1 };
        let noise = PhiloxNoise::new((0..rows as u64).map(row).collect(), device);
        let state = world.initial_state(rows);
        let mut batch = Self { world, state, frame, action, noise };
        batch.state = batch.observe();
        batch.imagine();
        Ok(batch)
    }

    fn observe(&self) -> State {
        let Self { world, state, frame, action, noise } = self;
        world.observe(state, Some(frame), action, noise, Outputs::default()).0
    }

    fn imagine(&self) -> State {
        let Self { world, state, action, noise, .. } = self;
        world.imagine(state, action, noise, Outputs::default()).0
    }
}

/// A batch of sequences to train on.
struct Sequence {
    checkpoint: Checkpoint,
    frames: Vec<Tensor>,
    action: Tensor,
    rows: i64,
}

impl Sequence {
    fn new(checkpoint: &Path, rows: i64) -> Result<Self> {
        let checkpoint = Checkpoint::load(checkpoint, Device::Cpu)?;
        let size = checkpoint.header.model.image_size;
        let frame = |_| Tensor::rand([rows, 3, size, size], (Kind::Float, Device::Cpu));
        let actions = [rows, checkpoint.header.model.action.dim];
        let action = Tensor::randn(actions, (Kind::Float, Device::Cpu));
        Ok(Self { checkpoint, frames: (0..SEQUENCE).map(frame).collect(), action, rows })
    }

    /// The loss of the sequences and its gradients.
    fn train(&self) {
        let Checkpoint { model, store, .. } = &self.checkpoint;
        for (_, parameter) in store.trainable() {
            parameter.shallow_clone().zero_grad();
        }
        let mut state = model.initial_state(self.rows);
        let mut total = Tensor::zeros([self.rows], (Kind::Float, Device::Cpu));
        for (step, frame) in (0..).zip(&self.frames) {
            let first = state.first();
            let row = |row| RowNoise::Sample { seed: row, sample: 0, step };
            let noise = PhiloxNoise::new((0..self.rows as u64).map(row).collect(), Device::Cpu);
            let how = Observing {
                train: true,
                priors: true,
                objects: true,
                discover: Discover::All,
                tracking: model.config().tracking,
                stops: GradientStops::default(),
            };
            let (next, seen) = model.observe(state, frame, &self.action, &noise, how);
            let image = model.render(&next).over(&seen.mixture.mu_mix);
            let (masks, comps) = loss::mixture_kl(&seen.mixture);
            let config = &model.config().objects;
            let objects = seen.objects.expect("the object module is on");
            let objects = objects.kl(&config.prior, config.aux_presence_kl).total();
            total = total - loss::gaussian_log_likelihood(frame, &image, SIGMA)
                + masks
                + comps
                + objects
                + loss::residual_norm(&seen.mixture, &first);
            state = next;
        }
        total.mean(Kind::Float).backward();
    }
}

/// Makes a step as often as there is time for, at least once; returns how often, and the multiply-accumulates of one.
fn repeat<T>(time: Duration, step: impl Fn() -> T) -> (u32, u64) {
    let (began, mut made, mut macs) = (Instant::now(), 0, 0);
    while made == 0 || began.elapsed() < time {
        (_, macs) = count_macs(&step);
        made += 1;
    }
    (made, macs)
}
