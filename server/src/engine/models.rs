//! The models of the engine, as everybody else sees them.
//!
//! A model is served for as long as anybody holds its [`ModelEntry`]: the catalogue of names, a session, a request
//! on its way. When the last one lets go, the engine forgets the weights.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Weak,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use gatsbi_models::{
    idle::asking_for,
    noise::PhiloxNoise,
    scene::Outputs,
    state::StateRow,
    world_model::{ModelSpec, WorldModel},
};
use tch::{Device, Kind, Tensor};
use tokio::sync::mpsc;

use super::{commands::Command, scheduler::Sizes};

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

/// A model of the engine: unique, and never used again for another one.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub struct ModelId(pub u64);

/// What the engine tells about a model. Holding on to it keeps the model served.
#[derive(Debug)]
pub struct ModelEntry {
    /// Which.
    pub id: ModelId,
    /// What it takes and gives, with the name that it is served under.
    pub spec: ModelSpec,
    /// Its card, Markdown; empty if it has none.
    pub card: String,
    /// Bytes of a state row.
    pub row_bytes: usize,
    /// Where it computes, such as `cpu` or `cuda:0`.
    pub device: String,
    /// The state of a session that has seen nothing.
    pub initial: Arc<StateRow>,
    pub(super) costs: Costs,
    engine: mpsc::WeakSender<Command>,
}

impl Drop for ModelEntry {
    fn drop(&mut self) {
        if let Some(engine) = self.engine.upgrade() {
            // Where there is no room the engine is busy, and looks by itself.
            engine.try_send(Command::Unused).ok();
        }
    }
}

/// A model on its way to the model's thread.
pub(super) struct Newcomer {
    pub(super) entry: Weak<ModelEntry>,
    pub(super) id: ModelId,
    pub(super) model: LoadedModel,
}

impl std::fmt::Debug for Newcomer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Newcomer").field("id", &self.id).finish_non_exhaustive()
    }
}

/// What one block of each kind costs, as measured.
#[derive(Debug)]
pub(super) struct Costs {
    pub(super) observe: Cost,
    pub(super) imagine: Cost,
    pub(super) wide: Cost,
}

impl Costs {
    /// Of imagine blocks of so many lanes.
    pub(super) fn of_imagine(&self, lanes: usize) -> &Cost {
        if lanes == self.imagine.lanes { &self.imagine } else { &self.wide }
    }
}

/// A block's cost, which grows evenly from that of a single row to that of a full block. Its scale follows what is
/// measured: an eighth of the way each time, and never by more than a factor of two, so that a hiccup of the machine
/// does not turn requests away for long.
#[derive(Debug)]
pub(super) struct Cost {
    /// Nanoseconds of a full block.
    full: AtomicU64,
    /// A single row's cost over a full block's.
    one: f64,
    lanes: usize,
}

impl Cost {
    /// From what a single row and a full block of so many took.
    pub(super) fn new(one: Duration, full: Duration, lanes: usize) -> Self {
        let full = (full.as_nanos() as u64).max(1);
        let one = (one.as_nanos() as f64 / full as f64).min(1.0);
        Self { full: AtomicU64::new(full), one, lanes }
    }

    /// Of a full block.
    pub(super) fn full(&self) -> Duration {
        Duration::from_nanos(self.full.load(Ordering::Relaxed))
    }

    /// Of a block with so many rows.
    pub(super) fn of(&self, rows: usize) -> Duration {
        self.full().mul_f64(self.share(rows))
    }

    fn share(&self, rows: usize) -> f64 {
        let others = self.lanes.saturating_sub(1).max(1) as f64;
        self.one + (1.0 - self.one) * (rows.saturating_sub(1) as f64 / others)
    }

    /// Only the model's thread measures.
    pub(super) fn measured(&self, rows: usize, cost: Duration) {
        let old = self.full.load(Ordering::Relaxed);
        let full = (cost.as_nanos() as f64 / self.share(rows)) as u64;
        let new = full.clamp(old / 2, old * 2);
        self.full.store(((old * 7 + new) / 8).max(1), Ordering::Relaxed);
    }
}

/// What is told about a model that was warmed up.
pub(super) fn entry(
    id: ModelId,
    model: &LoadedModel,
    costs: Costs,
    engine: mpsc::WeakSender<Command>,
) -> ModelEntry {
    let initial = model.world.initial_state(1).to_rows().remove(0);
    let device = match model.world.device() {
        Device::Cuda(index) => format!("cuda:{index}"),
        Device::Mps => "mps".to_owned(),
        Device::Vulkan => "vulkan".to_owned(),
        Device::Cpu => "cpu".to_owned(),
    };
    ModelEntry {
        id,
        spec: ModelSpec { name: model.name.clone(), ..model.world.spec().clone() },
        card: model.card.clone(),
        row_bytes: model.world.layout().row_bytes(),
        device,
        initial: Arc::new(initial),
        costs,
        engine,
    }
}

/// Makes steps of each kind in the shapes that will be used, so that the first request does not pay for it, and
/// measures the second ones.
pub(super) fn warm_up(world: &dyn WorldModel, sizes: Sizes) -> Result<Costs, String> {
    let steps = || {
        let _no_grad = tch::no_grad_guard();
        let device = world.device();
        let neutral = Tensor::from_slice(&world.spec().neutral_action()).to_device(device);
        let actions = |rows: i64| neutral.unsqueeze(0).expand([rows, -1], false).contiguous();
        let observed = sizes.observe_block as i64;
        let size = world.spec().image_size;
        let frames = Tensor::full([observed, 3, size, size], 0.5, (Kind::Float, device));
        let observe = |frame: Option<&Tensor>| {
            let noise = PhiloxNoise::mean(observed, device);
            let state = world.initial_state(observed);
            let (state, _) =
                world.observe(&state, frame, &actions(observed), &noise, Outputs::default());
            state.to_rows();
        };
        let imagine = |lanes: usize| {
            let noise = PhiloxNoise::mean(lanes as i64, device);
            let state = world.initial_state(lanes as i64);
            let actions = actions(lanes as i64);
            let (state, _) = world.imagine(&state, &actions, &noise, Outputs::default());
            state.to_rows();
        };
        let cost = |lanes: usize, step: &dyn Fn()| {
            let asked: Vec<bool> = (0..lanes).map(|lane| lane == 0).collect();
            let one = timed(|| asking_for(&asked, step));
            Cost::new(one, timed(step), lanes)
        };
        let imagined = |lanes: usize| {
            imagine(lanes);
            cost(lanes, &|| imagine(lanes))
        };
        observe(Some(&frames));
        observe(None);
        Costs {
            observe: cost(sizes.observe_block, &|| observe(Some(&frames))),
            imagine: imagined(sizes.imagine_block),
            wide: imagined(sizes.wide_block),
        }
    };
    let panicked = || format!("{} panicked in its first steps", world.spec().name);
    catch_unwind(AssertUnwindSafe(steps)).ok().ok_or_else(panicked)
}

fn timed(step: impl FnOnce()) -> Duration {
    let began = Instant::now();
    step();
    began.elapsed()
}

/// A model that nobody serves, for tests of what only holds on to one: images of 2 x 2 pixels, no action, and
/// states of `floats` floats and `ints` integers.
#[cfg(test)]
pub(crate) fn made_up(hash: &str, floats: usize, ints: usize) -> Arc<ModelEntry> {
    let spec = ModelSpec {
        name: "made up".to_owned(),
        hash: hash.to_owned(),
        image_size: 2,
        preprocess: gatsbi_models::world_model::Preprocess::Stretch,
        frame_period: None,
        actions: Vec::new(),
        slots: 1,
        agent_slot: None,
        max_objects: 1,
        keypoints: None,
        latents: 1,
        trained_steps: 0,
        provenance: String::new(),
    };
    let initial = StateRow { floats: vec![0.0; floats].into(), ints: vec![0; ints].into() };
    let cost = || Cost::new(Duration::from_millis(1), Duration::from_millis(1), 1);
    Arc::new(ModelEntry {
        id: ModelId(0),
        spec,
        card: String::new(),
        row_bytes: 4 * floats + 8 * ints,
        device: "cpu".to_owned(),
        initial: Arc::new(initial),
        costs: Costs { observe: cost(), imagine: cost(), wide: cost() },
        engine: mpsc::channel(1).0.downgrade(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cost_follows_what_lasts_and_not_a_hiccup() {
        let millis = Duration::from_millis;
        let cost = Cost::new(millis(16), millis(16), 1);
        cost.measured(1, Duration::from_secs(10));
        assert_eq!(cost.full(), millis(18));
        for _ in 0..100 {
            cost.measured(1, millis(40));
        }
        assert!(cost.full() > millis(39) && cost.full() <= millis(40));
        for _ in 0..100 {
            cost.measured(1, millis(8));
        }
        assert!(cost.full() >= millis(8) && cost.full() < millis(9));
    }

    #[test]
    fn rows_of_a_block_cost_the_same_whoever_measures() {
        let millis = Duration::from_millis;
        let cost = Cost::new(millis(4), millis(16), 4);
        assert_eq!([1, 2, 3, 4].map(|rows| cost.of(rows)), [4, 8, 12, 16].map(millis));
        for rows in [1, 2, 3, 4] {
            cost.measured(rows, cost.of(rows));
        }
        assert_eq!(cost.full(), millis(16));
        for _ in 0..100 {
            cost.measured(2, millis(4));
        }
        assert!(cost.full() >= millis(8) && cost.full() < millis(9));
    }
}
