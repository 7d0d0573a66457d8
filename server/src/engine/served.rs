//! One model on the model's thread: its requests, computed block by block.
//!
//! Nothing here waits: answers go into channels that always have room (the door has seen to that), and whoever has
//! gone away is forgotten before the next tick.

use std::{
    collections::BTreeMap,
    sync::{Arc, Weak},
    time::Instant,
};

use gatsbi_models::{state::StateRow, world_model::WorldModel};
use tokio::sync::{mpsc, oneshot};

use super::{
    arena::Arena,
    batch::{Batch, Computed, Outcome, compute},
    commands::{Chunk, Failure, Imagine, Observe, Observed, Order},
    door::Door,
    models::{LoadedModel, ModelEntry, Newcomer},
    scheduler::{Block, JobId, RowStep, Scheduler, Sizes, Tick},
};
use crate::telemetry::{Kind, StepMetrics};

/// Outputs of this size are sent at once; larger chunks are split, so that messages stay under 4 MB.
const CHUNK_BYTES: usize = 1 << 20;

pub(super) type ObserveOrder = Order<Observe, oneshot::Sender<Result<Observed, Failure>>>;
pub(super) type ImagineOrder = Order<Imagine, mpsc::Sender<Result<Chunk, Failure>>>;

/// A model and the requests that it has.
pub(super) struct Served {
    entry: Weak<ModelEntry>,
    world: Box<dyn WorldModel>,
    scheduler: Scheduler,
    arena: Arena,
    observes: BTreeMap<JobId, ObserveOrder>,
    rollouts: BTreeMap<JobId, Rollout>,
    door: Arc<Door>,
    name: String,
    metrics: StepMetrics,
}

struct Rollout {
    order: ImagineOrder,
    /// Row steps that are still to be computed.
    left: u64,
}

impl Served {
    pub(super) fn new(newcomer: Newcomer, sizes: Sizes, door: Arc<Door>) -> Self {
        let Newcomer { entry, model: LoadedModel { world, name, .. }, .. } = newcomer;
        Self {
            entry,
            scheduler: Scheduler::new(sizes),
            arena: Arena::new(world.layout(), sizes.slots, world.device()),
            observes: BTreeMap::new(),
            rollouts: BTreeMap::new(),
            door,
            metrics: StepMetrics::new(&name),
            name,
            world,
        }
    }

    /// Whether nobody can ask for it any more, and nobody does.
    pub(super) fn is_unused(&self) -> bool {
        self.entry.strong_count() == 0
    }

    pub(super) fn scheduler(&self) -> &Scheduler {
        &self.scheduler
    }

    /// Takes on an observe.
    pub(super) fn add_observe(&mut self, id: JobId, order: ObserveOrder) {
        let Observe { frame, lane, deadline, urgency, .. } = &order.job;
        self.scheduler.observe(id, (frame.is_some(), *urgency), *lane, *deadline);
        self.observes.insert(id, order);
    }

    /// Takes on a rollout.
    pub(super) fn add_rollout(&mut self, id: JobId, order: ImagineOrder) {
        let job = &order.job;
        let lanes = job.starts.iter().map(|start| start.lane);
        let steps = job.last_depth();
        self.scheduler.imagine(id, job.tenant, lanes, steps, job.deadline);
        let left = u64::from(job.rows()) * u64::from(steps);
        self.rollouts.insert(id, Rollout { order, left });
    }

    /// What is to be computed next, with rollouts in about `time`, of which so many blocks are computed at once.
    pub(super) fn next_tick(&mut self, time: std::time::Duration, workers: usize) -> Tick {
        self.forget_the_gone();
        let block = self.entry.upgrade().map(|entry| entry.costs.imagine.full().as_nanos());
        let rounds = (time.as_nanos() / block.unwrap_or(u128::MAX)).clamp(1, 64) as usize;
        let blocks = rounds * workers;
        let mut tick = self.scheduler.tick(Instant::now(), blocks, workers);
        for job in std::mem::take(&mut tick.expired) {
            self.fail(job, Failure::Late);
        }
        tick
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

    /// Computes blocks of observes at the same time.
    pub(super) fn observe(&mut self, blocks: &[Block<JobId>]) {
        let batch = |block: &Block<JobId>| {
            let jobs: Vec<Option<&Observe>> =
                block.iter().map(|job| job.map(|job| &self.observes[&job].job)).collect();
            Batch::observe(&jobs)
        };
        let batches = blocks.iter().map(batch).collect();
        let outcomes = compute(self.world.as_ref(), batches);
        for (block, outcome) in blocks.iter().zip(outcomes) {
            self.observed(block, outcome);
        }
    }

    fn observed(&mut self, block: &Block<JobId>, outcome: Outcome) {
        self.measured(Kind::Observe, block, &outcome);
        let Outcome { computed, started, .. } = outcome;
        let computed = match computed {
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
                besides: computed.spread(lane..lane + 1, order.job.wanted),
                spent,
            };
            // Who has gone away meanwhile does not get it, and the session does not move.
            order.reply.send(Ok(observed)).ok();
        }
    }

    /// Computes blocks of steps of rollouts at the same time.
    pub(super) fn imagine(&mut self, blocks: &[Block<RowStep>]) {
        // A request that failed in an earlier block of this tick is not computed further.
        let left = |step: &RowStep| self.rollouts.contains_key(&step.job);
        let blocks: Vec<Block<RowStep>> = blocks
            .iter()
            .map(|block| block.iter().map(|step| step.filter(left)).collect())
            .filter(|block: &Block<RowStep>| block.iter().any(Option::is_some))
            .collect();
        for block in &blocks {
            self.enter(block);
        }
        let batch = |block: &Block<RowStep>| {
            let steps: Vec<Option<(&Imagine, RowStep)>> = block
                .iter()
                .map(|step| step.map(|step| (&self.rollouts[&step.job].order.job, step)))
                .collect();
            Batch::imagine(&steps, &self.arena)
        };
        let batches = blocks.iter().map(batch).collect();
        let outcomes = compute(self.world.as_ref(), batches);
        for (block, outcome) in blocks.iter().zip(outcomes) {
            self.imagined(block, outcome);
        }
    }

    fn imagined(&mut self, block: &Block<RowStep>, outcome: Outcome) {
        self.measured(Kind::Imagine, block, &outcome);
        let Outcome { computed, started, .. } = outcome;
        let computed = match computed {
            Ok(computed) => computed,
            Err(panic) => return self.isolate(block, &panic, |step| step.job, Self::imagine),
        };
        for (lane, step) in block.iter().enumerate() {
            let Some(step) = step else { continue };
            if !computed.finite[lane] && self.rollouts.contains_key(&step.job) {
                self.report(step.job, "imagining", "numbers that are not finite");
                self.fail(step.job, Failure::NotFinite);
            }
        }
        self.keep(block, &computed);
        self.deliver(block, &computed, started);
    }

    fn measured<T>(&self, kind: Kind, block: &Block<T>, outcome: &Outcome) {
        let (rows, elapsed) = (block.iter().flatten().count(), outcome.elapsed);
        self.metrics.batch(kind, rows, block.len(), elapsed);
        self.door.gauges.block(kind, rows, block.len(), elapsed);
        let Some(entry) = self.entry.upgrade() else { return };
        let cost = match kind {
            Kind::Observe => &entry.costs.observe,
            Kind::Imagine => entry.costs.of_imagine(block.len()),
        };
        self.door.measured(cost, rows, elapsed);
    }

    /// Brings the pinned beliefs of rows that start into their slots.
    fn enter(&mut self, block: &Block<RowStep>) {
        let fresh = block.iter().flatten().filter(|step| step.depth == 1);
        let fresh = fresh.map(|step| {
            let start = &self.rollouts[&step.job].order.job.starts[step.row as usize];
            (step.slot, &start.state)
        });
        let (slots, rows): (Vec<u32>, Vec<&Arc<StateRow>>) = fresh.unzip();
        if !slots.is_empty() {
            self.arena.enter(&slots, &rows);
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
            let ends = job.states && first.depth == job.last_depth();
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
                        states: if ends { computed.states(&lanes) } else { Vec::new() },
                        spread: computed.spread(lanes.clone(), job.wanted),
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
        again: impl Fn(&mut Self, &[Block<T>]),
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
            again(self, &[alone]);
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
