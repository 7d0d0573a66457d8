//! The engine: the models on a thread of their own, reached by bounded channels only.
//!
//! [`Engine`] is the handle that everybody else holds. Behind it [`door`] decides how much work is let in,
//! [`scheduler`] what is computed next, and [`executor`] computes it, with [`batch`] for one batch and [`arena`] for
//! the states of rollouts. Sessions are not known here: an observe brings a state and takes the next one along, so
//! a request that fails has changed nothing.

mod arena;
mod batch;
pub mod commands;
mod door;
mod executor;
pub mod scheduler;

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::Arc,
    thread::JoinHandle,
    time::{Duration, Instant},
};

use gatsbi_models::{noise::PhiloxNoise, scene::Outputs, world_model::WorldModel};
use tch::{Device, Kind, Tensor};
use tokio::sync::{OwnedSemaphorePermit, mpsc, oneshot};

use self::{
    commands::{Chunk, Command, Failure, Imagine, ModelEntry, ModelId, Observe, Observed, Order},
    door::Door,
    executor::{Executor, Pace},
    scheduler::Sizes,
};
use crate::error::Error;

pub use self::door::DoorSizes;

/// A model to be served.
pub struct LoadedModel {
    /// The model.
    pub world: Box<dyn WorldModel>,
    /// Name to serve it under.
    pub name: String,
    /// Its card, Markdown; empty if it has none.
    pub card: String,
}

impl std::fmt::Debug for LoadedModel {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("LoadedModel").field("name", &self.name).finish_non_exhaustive()
    }
}

/// Sizes of the engine.
#[derive(Clone, Copy, Debug)]
pub struct EngineConfig {
    /// Threads of one operation on the CPU.
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
    models: Arc<[ModelEntry]>,
    door: Arc<Door>,
}

/// The chunks of a rollout as they come; dropped, the rollout ends.
#[derive(Debug)]
pub struct Chunks {
    chunks: mpsc::Receiver<Result<Chunk, Failure>>,
    _outputs: OwnedSemaphorePermit,
}

impl Chunks {
    /// The next chunk; after the last chunk or a failure there is nothing to wait for.
    pub async fn next(&mut self) -> Option<Result<Chunk, Error>> {
        Some(self.chunks.recv().await?.map_err(Error::from))
    }
}

/// The model's thread cannot be started.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// There is no thread.
    #[error("the model's thread cannot be started")]
    Spawn(#[source] std::io::Error),
    /// A step on made-up input failed.
    #[error("a model failed its warm-up: {0}")]
    WarmUp(String),
}

impl Engine {
    /// Starts the thread, and waits until every model has made a step of each kind.
    ///
    /// # Errors
    /// If there is no thread, or a model fails.
    pub fn start(
        models: Vec<LoadedModel>,
        config: EngineConfig,
    ) -> Result<(Self, JoinHandle<()>), EngineError> {
        let entries: Vec<ModelEntry> = models.iter().enumerate().map(entry).collect();
        let door = Arc::new(Door::new(config.door));
        // Whoever was let in finds room here without waiting.
        let (commands, received) = mpsc::channel(config.door.observes + config.door.rows);
        let (ready, warm) = std::sync::mpsc::channel();
        let behind = Arc::clone(&door);
        let thread = std::thread::Builder::new()
            .name("gatsbi-engine".to_owned())
            .spawn(move || {
                // Threads of libtorch that have computed once do not hear of a later change.
                tch::set_num_threads(config.threads as i32);
                let warm =
                    models.iter().try_for_each(|model| warm_up(model.world.as_ref(), config.sizes));
                let failed = warm.is_err();
                if ready.send(warm).is_err() || failed {
                    return;
                }
                let pace = Pace { sizes: config.sizes, tick: config.tick };
                Executor::new(models, pace, &behind, received).run();
            })
            .map_err(EngineError::Spawn)?;
        match warm.recv() {
            Ok(Ok(())) => Ok((Self { commands, models: entries.into(), door }, thread)),
            Ok(Err(error)) => Err(EngineError::WarmUp(error)),
            Err(gone) => Err(EngineError::WarmUp(gone.to_string())),
        }
    }

    /// The models, sorted by name.
    pub fn models(&self) -> &[ModelEntry] {
        &self.models
    }

    /// A model.
    pub fn model(&self, id: ModelId) -> &ModelEntry {
        &self.models[id.0]
    }

    /// Makes a step with an observation.
    ///
    /// # Errors
    /// If too many wait, or the model fails, or the deadline passes.
    pub async fn observe(&self, job: Observe) -> Result<Observed, Error> {
        let ticket = self.door.admit_observe()?;
        let (reply, answer) = oneshot::channel();
        let command = Command::Observe(order(job, reply, ticket));
        self.commands.send(command).await.map_err(gone)?;
        Ok(answer.await.map_err(gone)??)
    }

    /// Starts a rollout that may give up to `output_bytes` of outputs.
    ///
    /// # Errors
    /// If too much is on its way already.
    pub async fn imagine(&self, job: Imagine, output_bytes: u64) -> Result<Chunks, Error> {
        let shape = (job.rows(), job.last_depth());
        let (ticket, outputs) = self.door.admit_rollout(shape, output_bytes)?;
        // One chunk per row and depth at most, split no further than by row, and one failure.
        let (reply, chunks) = mpsc::channel(shape.0 as usize * shape.1 as usize + 1);
        let command = Command::Imagine(order(job, reply, ticket));
        self.commands.send(command).await.map_err(gone)?;
        Ok(Chunks { chunks, _outputs: outputs })
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

fn entry((id, model): (usize, &LoadedModel)) -> ModelEntry {
    let initial = model.world.initial_state(1).to_rows().remove(0);
    let device = match model.world.device() {
        Device::Cuda(index) => format!("cuda:{index}"),
        Device::Mps => "mps".to_owned(),
        Device::Vulkan => "vulkan".to_owned(),
        Device::Cpu => "cpu".to_owned(),
    };
    ModelEntry {
        id: ModelId(id),
        spec: gatsbi_models::world_model::ModelSpec {
            name: model.name.clone(),
            ..model.world.spec().clone()
        },
        card: model.card.clone(),
        row_bytes: model.world.layout().row_bytes(),
        device,
        initial: Arc::new(initial),
    }
}

/// Makes a step of each kind in the shapes that will be used, so that the first request does not pay for it.
fn warm_up(world: &dyn WorldModel, sizes: Sizes) -> Result<(), String> {
    let steps = || {
        let float = (Kind::Float, world.device());
        let neutral = Tensor::from_slice(&world.spec().neutral_action()).to_device(world.device());
        let actions = |rows: i64| neutral.unsqueeze(0).expand([rows, -1], false).contiguous();
        let outputs = Outputs::default();
        let (observed, imagined) = (sizes.observe_block as i64, sizes.imagine_block as i64);
        let size = world.spec().image_size;
        let noise = PhiloxNoise::mean(observed, world.device());
        for frame in [Some(Tensor::full([observed, 3, size, size], 0.5, float)), None] {
            let state = world.initial_state(observed);
            world.observe(&state, frame.as_ref(), &actions(observed), &noise, outputs);
        }
        let noise = PhiloxNoise::mean(imagined, world.device());
        world.imagine(&world.initial_state(imagined), &actions(imagined), &noise, outputs);
    };
    let panicked = || format!("{} panicked", world.spec().name);
    catch_unwind(AssertUnwindSafe(steps)).ok().ok_or_else(panicked)
}
