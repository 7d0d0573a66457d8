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
};
use tokio::sync::{mpsc, oneshot};

use super::{door::Ticket, models::ModelEntry, models::Newcomer};
use crate::frame::Frame;

/// Whose work it is: rollouts are fair between tenants. A client may name itself; by default each session is one.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub struct Tenant(pub u128);

/// How soon work is wanted.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Urgency {
    /// Somebody waits for it: observations go before everything else, and what does not fit is refused at once.
    Live,
    /// It is one of many: observations share the time of rollouts, and what does not fit waits outside.
    Bulk,
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
    /// Which outputs are wanted as 32-bit floats besides: of rollouts for the spread over samples, of observations for
    /// who watches.
    pub spread: Outputs,
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
    pub model: Arc<ModelEntry>,
    /// The belief before.
    pub state: Arc<StateRow>,
    /// The image; absent if none came.
    pub frame: Option<Frame>,
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
    /// How soon it is wanted.
    pub urgency: Urgency,
}

/// A step with an observation.
#[derive(Debug)]
pub struct Observed {
    /// The belief after.
    pub state: Arc<StateRow>,
    /// What was wanted.
    pub values: Vec<Value>,
    /// What was wanted besides.
    pub besides: Vec<Value>,
    /// Where time went.
    pub spent: Spent,
}

/// Where a row of a rollout begins.
#[derive(Clone, Debug)]
pub struct RowStart {
    /// The belief, pinned: whatever becomes of its session, the rollout keeps it.
    pub state: Arc<StateRow>,
    /// How its first step draws.
    pub noise: RowNoise,
    /// What the row's lane follows from.
    pub lane: u64,
}

/// Asks for a rollout. Row r takes the actions of candidate `r % candidates`; it is its sample `r / candidates`.
#[derive(Clone, Debug)]
pub struct Imagine {
    /// The model.
    pub model: Arc<ModelEntry>,
    /// Whose it is.
    pub tenant: Tenant,
    /// The rows: candidates times samples.
    pub starts: Vec<RowStart>,
    /// `[candidates, horizon, A]` in raw units.
    pub actions: Arc<[f32]>,
    /// Candidates N.
    pub candidates: u32,
    /// Steps H of the actions.
    pub horizon: u32,
    /// What is wanted.
    pub wanted: Wanted,
    /// Of which depths.
    pub depths: Depths,
    /// Whether the states that the rows end in are wanted.
    pub states: bool,
    /// When the answer is of no use any more.
    pub deadline: Option<Instant>,
    /// How soon it is wanted.
    pub urgency: Urgency,
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
        self.starts.len() as u32
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
        match self.starts[row as usize].noise {
            RowNoise::Mean => RowNoise::Mean,
            RowNoise::Sample { seed, sample, step } => {
                RowNoise::Sample { seed, sample, step: step + u64::from(depth) - 1 }
            }
        }
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
    /// What was wanted for the spread.
    pub spread: Vec<Value>,
    /// The states that the rows ended in, if they were wanted and this is where they ended.
    pub states: Vec<StateRow>,
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

/// What the model's thread is told. Whoever gives up on an answer drops the receiving end.
#[derive(Debug)]
pub(super) enum Command {
    Observe(Order<Observe, oneshot::Sender<Result<Observed, Failure>>>),
    Imagine(Order<Imagine, mpsc::Sender<Result<Chunk, Failure>>>),
    /// A model to be served from now on.
    Serve(Newcomer),
    /// Nobody uses some model any more.
    Unused,
    /// The thread shall end, whatever it has to do.
    Stop,
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
