//! The engine: the models on a thread of their own, reached by bounded channels only.
//!
//! [`Engine`] is the handle that everybody else holds. Behind it [`door`] decides how much work is let in,
//! [`scheduler`] what is computed next, and [`executor`] computes it, with [`served`] for one model's requests,
//! [`batch`] for one batch and [`arena`] for the states of rollouts; [`models`] is what is known about models outside. Sessions are not known here: beliefs are
//! rows of numbers that never change and that whoever needs them shares. An observe brings one and takes the next one
//! along, so a request that fails has changed nothing, a fork costs no more than a pointer, and a rollout pins its
//! belief by holding on to it.
//!
//! Answers do not depend on load. A row's bytes follow from its request, the sizes of blocks, and the lane that the
//! request has in them ([`scheduler`]); random numbers follow from seed, sample and step alone. So with the same build,
//! libtorch, processor model, threads and block sizes, equal requests have equal bytes, alone or among any others,
//! whenever they come and whoever gives up meanwhile (`tests/api/mixes.rs`). Across builds, processors and block sizes,
//! and on CUDA, where libraries choose algorithms by themselves, answers agree to rounding only.

mod arena;
mod batch;
pub mod commands;
mod door;
mod executor;
mod gauges;
pub mod models;
pub mod scheduler;
mod served;

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use tokio::sync::{OwnedSemaphorePermit, mpsc, oneshot};

use self::{
    commands::{Chunk, Command, Failure, Imagine, Observe, Observed, Order, Urgency},
    door::{Door, Load},
    executor::Executor,
    models::{LoadedModel, ModelEntry, ModelId, Newcomer},
    scheduler::Sizes,
};
use crate::{access::tenants::Share, error::Error};

pub use self::{
    door::DoorSizes,
    gauges::{Computed, Reading},
};

/// Sizes of the engine.
#[derive(Clone, Copy, Debug)]
pub struct EngineConfig {
    /// Blocks that are computed at once.
    pub workers: usize,
    /// Threads of one operation of each of them on the CPU.
    pub threads: usize,
    /// Rows of blocks, and rows on their way.
    pub sizes: Sizes,
    /// How long the rollout blocks of a tick should take together; one is always computed.
    pub tick: Duration,
    /// How much work is let in.
    pub door: DoorSizes,
}

/// The handle of the engine. The thread ends when the last handle is gone.
#[derive(Clone, Debug)]
pub struct Engine {
    commands: mpsc::Sender<Command>,
    door: Arc<Door>,
    next_model: Arc<AtomicU64>,
    config: EngineConfig,
}

/// The chunks of a rollout as they come; dropped, the rollout ends.
#[derive(Debug)]
pub struct Chunks {
    finished: mpsc::Receiver<Result<Chunk, Failure>>,
    _outputs: OwnedSemaphorePermit,
    _share: Share,
}

impl Chunks {
    /// The next chunk; after the last chunk or a failure there is nothing to wait for.
    pub async fn next(&mut self) -> Option<Result<Chunk, Error>> {
        Some(self.finished.recv().await?.map_err(Error::from))
    }
}

/// The engine cannot be started, or cannot serve a model.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// There is no thread.
    #[error("the model's thread cannot be started")]
    Spawn(#[source] std::io::Error),
    /// A step on made-up input failed.
    #[error("a model failed its warm-up: {0}")]
    WarmUp(String),
    /// The engine has ended.
    #[error("the engine has ended")]
    Ended,
}

impl Engine {
    /// Starts the thread, with no model yet.
    ///
    /// # Errors
    /// If there is no thread.
    pub fn start(config: EngineConfig) -> Result<(Self, JoinHandle<()>), EngineError> {
        let door = Arc::new(Door::new(config.door, config.sizes, config.workers));
        // Whoever was let in finds room here without waiting; of bulk work there is half as much.
        let most = 2 * (config.door.observes + config.door.rows);
        let (commands, received) = mpsc::channel(most);
        let executor = Executor::new(config, Arc::clone(&door), received);
        let thread = std::thread::Builder::new()
            .name("gatsbi-engine".to_owned())
            .spawn(move || {
                // Threads of libtorch that have computed once do not hear of a later change.
                tch::set_num_threads(config.threads as i32);
                executor.run();
            })
            .map_err(EngineError::Spawn)?;
        Ok((Self { commands, door, next_model: Arc::default(), config }, thread))
    }

    /// Serves a model from now on, for as long as the answer is held. Its first steps are made here, on the thread
    /// that calls, which should be one that may be kept busy: nobody else waits for them.
    ///
    /// # Errors
    /// If the model fails its first steps, or the engine has ended.
    pub fn serve(&self, model: LoadedModel) -> Result<Arc<ModelEntry>, EngineError> {
        let costs = models::warm_up(model.world.as_ref(), self.config.sizes)
            .map_err(EngineError::WarmUp)?;
        let id = ModelId(self.next_model.fetch_add(1, Ordering::Relaxed));
        let entry = Arc::new(models::entry(id, &model, costs, self.commands.downgrade()));
        let newcomer = Newcomer { entry: Arc::downgrade(&entry), id, model };
        let served = self.commands.blocking_send(Command::Serve(newcomer));
        served.map_err(|_ended| EngineError::Ended)?;
        Ok(entry)
    }

    /// Ends the thread before the last handle is gone, after the blocks that are being computed: requests on their way
    /// get no answer.
    pub async fn stop(&self) {
        // If it has ended already, there is nobody to hear it.
        self.commands.send(Command::Stop).await.ok();
    }

    /// The most that a bulk rollout may be, in rows and bytes of outputs.
    pub fn bulk_limit(&self) -> (u32, u64) {
        Door::bulk_limit(self.config.door)
    }

    /// What it has done so far, and what waits.
    pub fn reading(&self) -> Reading {
        self.door.gauges.read(self.door.waiting())
    }

    /// Makes a step with an observation.
    ///
    /// # Errors
    /// If too many wait, or the model fails, or the deadline passes.
    pub async fn observe(&self, job: Observe) -> Result<Observed, Error> {
        let costs = &job.model.costs;
        let ticket = match job.urgency {
            Urgency::Live => self.door.admit_observe(costs, job.deadline),
            Urgency::Bulk => self.door.admit_bulk_observe(costs).await,
        };
        let ticket = ticket.inspect_err(|_| self.door.gauges.refused())?;
        let (reply, answer) = oneshot::channel();
        let command = Command::Observe(order(job, reply, ticket));
        self.commands.send(command).await.map_err(gone)?;
        Ok(answer.await.map_err(gone)??)
    }

    /// Starts a rollout that may give up to `output_bytes` of outputs; its tenant's share is held as long as it is
    /// under way.
    ///
    /// # Errors
    /// If too much is on its way already, or it cannot be done by its deadline.
    pub async fn imagine(
        &self,
        job: Imagine,
        output_bytes: u64,
        share: Share,
    ) -> Result<Chunks, Error> {
        let (rows, steps) = (job.rows(), job.last_depth());
        let load = Load { rows, steps, output_bytes, deadline: job.deadline };
        let costs = &job.model.costs;
        let admitted = match job.urgency {
            Urgency::Live => self.door.admit_rollout(costs, load),
            Urgency::Bulk => self.door.admit_bulk_rollout(costs, load).await,
        };
        let (ticket, outputs) = admitted.inspect_err(|_| self.door.gauges.refused())?;
        // One chunk per row and depth at most, split no further than by row, and one failure.
        let (reply, chunks) = mpsc::channel(rows as usize * steps as usize + 1);
        let command = Command::Imagine(order(job, reply, ticket));
        self.commands.send(command).await.map_err(gone)?;
        Ok(Chunks { finished: chunks, _outputs: outputs, _share: share })
    }
}

impl From<Failure> for Error {
    fn from(failure: Failure) -> Self {
        match failure {
            Failure::Late => Self::DeadlineExceeded,
            Failure::Panicked => Self::ModelFailed,
            Failure::NotFinite => Self::NotFinite,
        }
    }
}

fn order<Job, Reply>(job: Job, reply: Reply, ticket: door::Ticket) -> Order<Job, Reply> {
    Order { job, reply, ticket, since: Instant::now(), span: tracing::Span::current() }
}

/// The thread has ended, which it does only when the process does.
fn gone<E>(_: E) -> Error {
    Error::ShuttingDown
}
