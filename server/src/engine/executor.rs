//! The model's thread: takes commands in, computes what the scheduler says, hands results out.
//!
//! A tick at a time, model after model. Nothing here waits while there is work: commands are taken as they come,
//! answers go into channels that always have room (the door has seen to that), and whoever has gone away is
//! forgotten before the next tick.

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant},
};

use gatsbi_models::world_model::WorldModel;
use tokio::sync::{mpsc, oneshot};

use super::{
    LoadedModel,
    arena::Arena,
    batch::{Batch, Computed, compute},
    commands::{Chunk, Command, Failure, Imagine, ModelId, Observe, Observed, Order},
    door::Door,
    scheduler::{Block, JobId, RowStep, Scheduler, Sizes},
};
use crate::telemetry::{Kind, StepMetrics};

/// Outputs of this size are sent at once; larger chunks are split, so that messages stay under 4 MB.
const CHUNK_BYTES: usize = 1 << 20;

/// Sizes of the executor.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pace {
    pub(super) sizes: Sizes,
    /// How long the rollout blocks of a tick should take together; one is always computed.
    pub(super) tick: Duration,
}

/// The state of the model's thread.
pub(super) struct Executor {
    served: Vec<Served>,
    commands: mpsc::Receiver<Command>,
    next_job: u64,
}

/// A model and the requests that it has.
struct Served {
    world: Box<dyn WorldModel>,
    scheduler: Scheduler,
    arena: Arena,
    observes: BTreeMap<JobId, Order<Observe, oneshot::Sender<Result<Observed, Failure>>>>,
    rollouts: BTreeMap<JobId, Rollout>,
    pace: Pace,
    door: Arc<Door>,
    name: String,
    metrics: StepMetrics,
    /// Cost of an imagine block, smoothed.
    block_cost: Duration,
}

struct Rollout {
    order: Order<Imagine, mpsc::Sender<Result<Chunk, Failure>>>,
    /// Row steps that are still to be computed.
    left: u64,
}

impl Executor {
    pub(super) fn new(
        models: Vec<LoadedModel>,
        pace: Pace,
        door: &Arc<Door>,
        commands: mpsc::Receiver<Command>,
    ) -> Self {
        let served = models
            .into_iter()
            .map(|LoadedModel { world, name, .. }| Served {
                scheduler: Scheduler::new(pace.sizes),
                arena: Arena::new(world.layout(), pace.sizes.slots, world.device()),
                observes: BTreeMap::new(),
                rollouts: BTreeMap::new(),
                pace,
                door: Arc::clone(door),
                metrics: StepMetrics::new(&name),
                name,
                block_cost: Duration::ZERO,
                world,
            })
            .collect();
        Self { served, commands, next_job: 0 }
    }

    /// Works until nobody can ask any more.
    pub(super) fn run(mut self) {
        loop {
            if self.served.iter().all(|served| served.scheduler.is_idle()) {
                match self.commands.blocking_recv() {
                    Some(command) => self.accept(command),
                    None => return,
                }
            }
            while let Ok(command) = self.commands.try_recv() {
                self.accept(command);
            }
            for served in &mut self.served {
                served.tick();
            }
        }
    }

    fn accept(&mut self, command: Command) {
        let id = JobId(self.next_job);
        self.next_job += 1;
        match command {
            Command::Observe(order) => {
                let ModelId(model) = order.job.model;
                let served = &mut self.served[model];
                let Observe { frame, lane, deadline, .. } = &order.job;
                served.scheduler.observe(id, frame.is_some(), *lane, *deadline);
                served.observes.insert(id, order);
            }
            Command::Imagine(order) => {
                let ModelId(model) = order.job.model;
                let served = &mut self.served[model];
                let shape = (order.job.rows(), order.job.last_depth());
                let lane = order.job.seed.unwrap_or(0);
                served.scheduler.imagine(id, shape, lane, order.job.deadline);
                let left = u64::from(shape.0) * u64::from(shape.1);
                served.rollouts.insert(id, Rollout { order, left });
            }
        }
    }
}

impl Served {
    fn tick(&mut self) {
        self.forget_the_gone();
        if self.scheduler.is_idle() {
            return;
        }
        let tick = self.scheduler.tick(Instant::now(), self.blocks_of_a_tick());
        for job in tick.expired {
            self.fail(job, Failure::Late);
        }
        for block in tick.seeing.iter().chain(&tick.blind) {
            self.observe(block);
        }
        for block in &tick.imagine {
            self.imagine(block);
        }
    }

    /// How many imagine blocks fit into a tick, by what they were measured to cost.
    fn blocks_of_a_tick(&self) -> usize {
        match self.block_cost.as_nanos() {
            0 => 1,
            cost => (self.pace.tick.as_nanos() / cost).clamp(1, 64) as usize,
        }
    }

    fn forget_the_gone(&mut self) {
        let observes = self.observes.iter().filter(|(_, order)| order.reply.is_closed());
        let rollouts = self.rollouts.iter().filter(|(_, rollout)| rollout.order.reply.is_closed());
        let gone: Vec<JobId> =
            observes.map(|(job, _)| *job).chain(rollouts.map(|(job, _)| *job)).collect();
        for job in gone {
            tracing::debug!(job = job.0, "request was given up by its client");
            self.metrics.given_up();
            self.scheduler.cancel(job);
            self.observes.remove(&job);
            self.rollouts.remove(&job);
        }
    }

    /// Ends a request with a failure.
    fn fail(&mut self, job: JobId, failure: Failure) {
        self.metrics.failed(failure);
        self.scheduler.cancel(job);
        // Who has gone away meanwhile does not hear it.
        if let Some(order) = self.observes.remove(&job) {
            order.reply.send(Err(failure)).ok();
        }
        if let Some(rollout) = self.rollouts.remove(&job) {
            rollout.order.reply.try_send(Err(failure)).ok();
        }
    }

    fn observe(&mut self, block: &Block<JobId>) {
        let started = Instant::now();
        let orders: Vec<Option<&Order<Observe, _>>> =
            block.iter().map(|job| job.map(|job| &self.observes[&job])).collect();
        let jobs: Vec<Option<&Observe>> =
            orders.iter().map(|order| order.map(|order| &order.job)).collect();
        let batch = Batch::observe(&jobs);
        let rows = batch.rows();
        let span = tracing::debug_span!("observe_batch", rows, lanes = block.len());
        let result = span.in_scope(|| compute(self.world.as_ref(), batch));
        let elapsed = started.elapsed();
        self.metrics.batch(Kind::Observe, rows, block.len(), elapsed);
        self.door.measured(true, elapsed / rows as u32);
        let computed = match result {
            Ok(computed) => computed,
            Err(panic) => return self.isolate(block, &panic, |job| *job, Self::observe),
        };
        for (lane, job) in block.iter().enumerate() {
            let Some(job) = job else { continue };
            if !computed.finite[lane] {
                self.report(*job, "observing", "numbers that are not finite");
                self.fail(*job, Failure::NotFinite);
                continue;
            }
            let Some(order) = self.observes.remove(job) else { continue };
            let spent = computed.spent(started - order.since);
            let observed = Observed {
                state: Arc::new(
                    computed.rows.as_ref().expect("observing gives rows")[lane].clone(),
                ),
                values: computed.row_values(lane, order.job.wanted),
                spent,
            };
            // Who has gone away meanwhile does not get it, and the session does not move.
            order.reply.send(Ok(observed)).ok();
        }
    }

    fn imagine(&mut self, block: &Block<RowStep>) {
        // A request that failed in an earlier block of this tick is not computed further.
        let block: Block<RowStep> = block
            .iter()
            .map(|step| step.filter(|step| self.rollouts.contains_key(&step.job)))
            .collect();
        if block.iter().all(Option::is_none) {
            return;
        }
        let started = Instant::now();
        self.enter(&block);
        let steps: Vec<Option<(&Imagine, RowStep)>> = block
            .iter()
            .map(|step| step.map(|step| (&self.rollouts[&step.job].order.job, step)))
            .collect();
        let batch = Batch::imagine(&steps, &self.arena);
        let rows = batch.rows();
        let span = tracing::debug_span!("imagine_batch", rows, lanes = block.len());
        let result = span.in_scope(|| compute(self.world.as_ref(), batch));
        let elapsed = started.elapsed();
        self.metrics.batch(Kind::Imagine, rows, block.len(), elapsed);
        self.door.measured(false, elapsed / rows as u32);
        self.block_cost = match self.block_cost {
            Duration::ZERO => elapsed,
            smoothed => (smoothed * 7 + elapsed) / 8,
        };
        let computed = match result {
            Ok(computed) => computed,
            Err(panic) => return self.isolate(&block, &panic, |step| step.job, Self::imagine),
        };
        for (lane, step) in block.iter().enumerate() {
            let Some(step) = step else { continue };
            if !computed.finite[lane] && self.rollouts.contains_key(&step.job) {
                self.report(step.job, "imagining", "numbers that are not finite");
                self.fail(step.job, Failure::NotFinite);
            }
        }
        self.keep(&block, &computed);
        self.deliver(&block, &computed, started);
    }

    /// Brings the pinned belief of rows that start into their slots.
    fn enter(&mut self, block: &Block<RowStep>) {
        let mut fresh: BTreeMap<JobId, Vec<u32>> = BTreeMap::new();
        for step in block.iter().flatten().filter(|step| step.depth == 1) {
            fresh.entry(step.job).or_default().push(step.slot);
        }
        for (job, slots) in fresh {
            self.arena.enter(&slots, &self.rollouts[&job].order.job.start);
        }
    }

    /// Puts the new states of rows back into their slots.
    fn keep(&mut self, block: &Block<RowStep>, computed: &Computed) {
        let taken =
            block.iter().enumerate().filter_map(|(lane, step)| Some((lane as i64, (*step)?)));
        let (lanes, slots): (Vec<i64>, Vec<u32>) =
            taken.map(|(lane, step)| (lane, step.slot)).unzip();
        self.arena.put(&slots, &computed.gather(&lanes));
    }

    /// Sends the outputs of a block as chunks of neighbouring candidates.
    fn deliver(&mut self, block: &Block<RowStep>, computed: &Computed, started: Instant) {
        for run in runs(block, &self.rollouts) {
            let first = block[run.start].expect("runs hold taken lanes");
            let Some(rollout) = self.rollouts.get_mut(&first.job) else { continue };
            let job = &rollout.order.job;
            rollout.left -= run.len() as u64;
            rollout.order.ticket.done(run.len() as u64);
            let done = rollout.left == 0;
            if job.wants(first.depth) {
                let most = (CHUNK_BYTES / computed.row_bytes(job.wanted).max(1)).max(1);
                let spent = computed.spent(started.saturating_duration_since(rollout.order.since));
                for start in run.clone().step_by(most) {
                    let lanes = start..run.end.min(start + most);
                    let row = first.row + (start - run.start) as u32;
                    let chunk = Chunk {
                        sample: row / job.candidates,
                        first_candidate: row % job.candidates,
                        candidates: lanes.len() as u32,
                        depth: first.depth,
                        last: done && lanes.end == run.end,
                        values: computed.values(lanes, job.wanted),
                        spent,
                    };
                    // There is room for every chunk; who has gone away is forgotten before the next tick.
                    rollout.order.reply.try_send(Ok(chunk)).ok();
                }
                rollout.order.since = Instant::now();
            }
            if done {
                self.rollouts.remove(&first.job);
            }
        }
    }

    /// After a panic: tells which request is at fault by computing each one alone, in the same lanes.
    fn isolate<T: Copy>(
        &mut self,
        block: &Block<T>,
        panic: &str,
        job_of: impl Fn(&T) -> JobId,
        again: impl Fn(&mut Self, &Block<T>),
    ) {
        let mut jobs: Vec<JobId> = block.iter().flatten().map(&job_of).collect();
        jobs.sort_unstable();
        jobs.dedup();
        if let [job] = jobs[..] {
            self.report(job, "computing", panic);
            return self.fail(job, Failure::Panicked);
        }
        for job in jobs {
            let alone: Block<T> =
                block.iter().map(|row| row.filter(|row| job_of(row) == job)).collect();
            again(self, &alone);
        }
    }

    /// Logs a failure of the model in the span of the request that it hits.
    fn report(&self, job: JobId, doing: &str, found: &str) {
        let observe = self.observes.get(&job).map(|order| &order.span);
        let span = observe.or_else(|| self.rollouts.get(&job).map(|rollout| &rollout.order.span));
        let _entered = span.map(tracing::Span::enter);
        tracing::error!(model = self.name, doing, found, "the model failed");
    }
}

/// Runs of lanes that hold neighbouring candidates of one sample of one rollout at one depth.
fn runs(
    block: &Block<RowStep>,
    rollouts: &BTreeMap<JobId, Rollout>,
) -> Vec<std::ops::Range<usize>> {
    let mut runs: Vec<std::ops::Range<usize>> = Vec::new();
    let mut previous: Option<RowStep> = None;
    for (lane, step) in block.iter().enumerate() {
        let follows = |step: &RowStep, before: &RowStep| {
            let candidates = rollouts.get(&step.job).map_or(1, |r| r.order.job.candidates);
            step.job == before.job
                && step.depth == before.depth
                && step.row == before.row + 1
                && !step.row.is_multiple_of(candidates)
        };
        match (step, &previous, runs.last_mut()) {
            (Some(step), Some(before), Some(run)) if follows(step, before) => run.end += 1,
            (Some(_), _, _) => runs.push(lane..lane + 1),
            (None, _, _) => {}
        }
        previous = *step;
    }
    runs
}
