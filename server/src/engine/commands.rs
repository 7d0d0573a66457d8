//! What the engine is asked, and what it answers: plain data that crosses to the model's thread.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::Bytes;
use gatsbi_models::{
    noise::RowNoise,
    scene::{Output, Outputs},
    state::StateRow,
    world_model::ModelSpec,
};
use tokio::sync::{mpsc, oneshot};

use super::door::Ticket;

/// A model of the engine, by position.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct ModelId(pub usize);

/// What the engine tells about a model.
#[derive(Clone, Debug)]
pub struct ModelEntry {
    /// Which.
    pub id: ModelId,
    /// What it takes and gives.
    pub spec: ModelSpec,
    /// Its card, Markdown; empty if it has none.
    pub card: String,
    /// Bytes of a state row.
    pub row_bytes: usize,
    /// Where it computes, such as `cpu` or `cuda:0`.
    pub device: String,
    /// The state of a session that has seen nothing.
    pub initial: Arc<StateRow>,
}

/// How numbers are given; object tables and single numbers are always 32-bit.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub enum Form {
    /// 32-bit floats.
    F32,
    /// 16-bit floats.
    F16,
    /// Images and masks as bytes, values in [0, 1] times 255; all else as 32-bit floats.
    U8,
}

/// What of a step is wanted.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Wanted {
    /// Which outputs.
    pub outputs: Outputs,
    /// How.
    pub form: Form,
}

/// Type of the numbers of a [`Value`].
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum NumberType {
    /// Unsigned bytes.
    U8,
    /// 16-bit floats.
    F16,
    /// 32-bit floats.
    F32,
    /// 64-bit integers.
    I64,
}

/// One output of some rows, images with colours last.
#[derive(Clone, Debug, PartialEq)]
pub struct Value {
    /// Which; the object table comes as two values, the identities with I64.
    pub output: Output,
    /// What the numbers are.
    pub numbers: NumberType,
    /// Shape of one row.
    pub shape: Vec<usize>,
    /// The rows one after the other, little-endian, row-major.
    pub data: Bytes,
}

/// Where time went.
#[derive(Clone, Copy, Debug, Default)]
pub struct Spent {
    /// Waiting for the model.
    pub queue: Duration,
    /// The model's step.
    pub compute: Duration,
    /// Bringing outputs to the host.
    pub encode: Duration,
}

/// Asks for a step with an observation.
#[derive(Debug)]
pub struct Observe {
    /// The model.
    pub model: ModelId,
    /// The belief before.
    pub state: Arc<StateRow>,
    /// Colours by row and column, `[3, H, W]` in [0, 1]; absent if no image came.
    pub frame: Option<Arc<[f32]>>,
    /// The action that led to it, `[A]` in raw units.
    pub action: Vec<f32>,
    /// How the row draws.
    pub noise: RowNoise,
    /// What the row's lane follows from.
    pub lane: u64,
    /// What is wanted.
    pub wanted: Wanted,
    /// When the answer is of no use any more.
    pub deadline: Option<Instant>,
}

/// A step with an observation.
#[derive(Debug)]
pub struct Observed {
    /// The belief after.
    pub state: Arc<StateRow>,
    /// What was wanted.
    pub values: Vec<Value>,
    /// Where time went.
    pub spent: Spent,
}

/// Asks for a rollout. Row r is candidate `r % candidates` of sample `r / candidates`.
#[derive(Clone, Debug)]
pub struct Imagine {
    /// The model.
    pub model: ModelId,
    /// The belief to start from.
    pub start: Arc<StateRow>,
    /// Steps that the belief has absorbed.
    pub step: u64,
    /// `[candidates, horizon, A]` in raw units.
    pub actions: Arc<[f32]>,
    /// Candidates N.
    pub candidates: u32,
    /// Steps H of the actions.
    pub horizon: u32,
    /// Samples S.
    pub samples: u32,
    /// Seed; absent for means.
    pub seed: Option<u64>,
    /// Whether candidates draw apart.
    pub independent: bool,
    /// What is wanted.
    pub wanted: Wanted,
    /// Of which depths.
    pub depths: Depths,
    /// When the answer is of no use any more.
    pub deadline: Option<Instant>,
}

/// Which depths of a rollout give outputs.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Depths {
    /// Every k-th.
    Every(u32),
    /// The last.
    Last,
}

impl Imagine {
    /// Rows of the rollout.
    pub fn rows(&self) -> u32 {
        self.candidates * self.samples
    }

    /// The depth after which nothing more is wanted.
    pub fn last_depth(&self) -> u32 {
        match self.depths {
            Depths::Every(k) => self.horizon / k * k,
            Depths::Last => self.horizon,
        }
    }

    /// Whether outputs of `depth` are wanted.
    pub fn wants(&self, depth: u32) -> bool {
        match self.depths {
            Depths::Every(k) => depth.is_multiple_of(k),
            Depths::Last => depth == self.horizon,
        }
    }

    /// How a row draws on its way to `depth`.
    pub fn noise(&self, row: u32, depth: u32) -> RowNoise {
        let Some(seed) = self.seed else { return RowNoise::Mean };
        let (candidate, sample) = (row % self.candidates, row / self.candidates);
        // Limits keep both below 2^16, so no two of them meet.
        let apart = if self.independent { candidate << 16 } else { 0 };
        RowNoise::Sample { seed, sample: sample | apart, step: self.step + u64::from(depth) - 1 }
    }

    /// The action that leads a row to `depth`.
    pub fn action(&self, row: u32, depth: u32) -> &[f32] {
        let width = self.actions.len() / (self.candidates as usize * self.horizon as usize);
        let at = (row % self.candidates) as usize * self.horizon as usize + depth as usize - 1;
        &self.actions[at * width..][..width]
    }
}

/// Neighbouring candidates of one sample at one depth.
#[derive(Debug)]
pub struct Chunk {
    /// Sample.
    pub sample: u32,
    /// First candidate.
    pub first_candidate: u32,
    /// How many.
    pub candidates: u32,
    /// Depth, from 1.
    pub depth: u32,
    /// What was wanted.
    pub values: Vec<Value>,
    /// Whether it is the rollout's last.
    pub last: bool,
    /// Where time went since the rollout's previous chunks.
    pub spent: Spent,
}

/// Why the engine does not answer.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Failure {
    /// The deadline passed.
    Late,
    /// The model panicked.
    Panicked,
    /// The model computed NaN or infinity.
    NotFinite,
}

/// A request on its way to the model's thread. Whoever gives up drops the receiving end.
#[derive(Debug)]
pub(super) enum Command {
    Observe(Order<Observe, oneshot::Sender<Result<Observed, Failure>>>),
    Imagine(Order<Imagine, mpsc::Sender<Result<Chunk, Failure>>>),
}

/// A request with the way back, the room it takes in the queue, and the span it belongs to.
#[derive(Debug)]
pub(super) struct Order<Job, Reply> {
    pub(super) job: Job,
    pub(super) reply: Reply,
    pub(super) ticket: Ticket,
    pub(super) since: Instant,
    pub(super) span: tracing::Span,
}
