//! Steps of a frozen model on one thread, beside its twin's (`tests/reference/gatsbi_twin/timing.py`).
//!
//! Each line `CHECKPOINT BATCH STEP SECONDS` has a step (`observe` or `imagine`) repeated for so long, at least once, and
//! is answered by how often it was made, the multiply-accumulates of one, and the bytes of a row's state; whoever asks
//! looks at the processor time meanwhile. Steps are those that a server makes: packed state, actions in raw units,
//! counter-based noise, new objects looked for in every frame, nothing drawn. The step `multiply` is a product of square
//! matrices, as fast as libtorch makes one: what the processor can do.

use std::{
    collections::{HashMap, hash_map::Entry},
    path::Path,
    time::{Duration, Instant},
};

use anyhow::{Result, bail};
use gatsbi_models::{
    gatsbi::world::GatsbiWorld,
    nn::count_macs,
    noise::{PhiloxNoise, RowNoise},
    scene::Outputs,
    state::State,
    world_model::WorldModel,
};
use tch::{Device, Kind, Tensor};

/// Rows of the matrices that are multiplied: large enough for full speed, small enough for a turn.
const SIDE: u64 = 1024;

/// Batches that have been asked for, by checkpoint and rows.
pub(crate) struct Steps {
    batches: HashMap<(String, i64), Batch>,
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
        Self { batches: HashMap::new(), square }
    }

    /// Measures what a line asks for; returns its numbers.
    pub(crate) fn measure(&mut self, line: &str) -> Result<String> {
        let &[checkpoint, rows, step, seconds] = &line.split(' ').collect::<Vec<_>>()[..] else {
            bail!("{line:?} is not CHECKPOINT BATCH STEP SECONDS");
        };
        let rows: i64 = rows.parse()?;
        let batch = match self.batches.entry((checkpoint.to_owned(), rows)) {
            Entry::Occupied(there) => there.into_mut(),
            Entry::Vacant(new) => new.insert(Batch::new(Path::new(checkpoint), rows)?),
        };
        let time = Duration::from_secs_f64(seconds.parse()?);
        let (made, macs) = match step {
            "observe" => repeat(time, || batch.observe()),
            "imagine" => repeat(time, || batch.imagine()),
            "multiply" => {
                let (made, _) = repeat(time, || self.square.matmul(&self.square));
                (made, SIDE.pow(3))
            }
            _ => bail!("{step:?} is not observe, imagine or multiply"),
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

/// Makes a step as often as there is time for, at least once; returns how often, and the multiply-accumulates of one.
fn repeat<T>(time: Duration, step: impl Fn() -> T) -> (u32, u64) {
    let (began, mut made, mut macs) = (Instant::now(), 0, 0);
    while made == 0 || began.elapsed() < time {
        (_, macs) = count_macs(&step);
        made += 1;
    }
    (made, macs)
}
