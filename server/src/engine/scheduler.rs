//! What is computed next: a pure state machine without threads or clock.
//!
//! Scheduling is iteration-level. At each tick every waiting observe and one time step of as many rollout rows as
//! fit are put into blocks; a row that is done makes room at the next tick, and rollouts that came meanwhile join.
//! Observes that nobody waits for ([`Urgency::Bulk`]) take a part of the rollouts' time.
//!
//! Blocks have fixed sizes, and a row's lane, its position in the block, follows from its request alone (seed and
//! row number), never from who else is there ([`blocks`]). Rows are shared evenly between tenants, and by each
//! tenant between its rollouts ([`rollouts`]).
//!
//! The scheduler knows requests by number only; what they compute is [`super::executor`]'s business.

mod blocks;
mod rollouts;
#[cfg(test)]
mod tests;

use std::{collections::VecDeque, time::Instant};

use self::{
    blocks::Blocks,
    rollouts::{Rollout, Shares},
};
use super::commands::{Tenant, Urgency};

pub use self::blocks::Block;

/// Number of a request, unique within the engine.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub struct JobId(pub u64);

/// Sizes of a scheduler.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Sizes {
    /// Rows of an observe block.
    pub observe_block: usize,
    /// Rows of an imagine block.
    pub imagine_block: usize,
    /// Rows of the imagine blocks of rollouts that have at least so many: a row costs less in them, but they keep others
    /// waiting for longer. No less than `imagine_block`.
    pub wide_block: usize,
    /// Rows that can be on their way through rollouts at once. No tenant holds more than half of them, so that there
    /// is room for whoever comes.
    pub slots: usize,
}

impl Sizes {
    /// Rows of the blocks in which a rollout of so many rows is computed. It follows from the request alone, as lanes do.
    pub fn block_for(self, rows: usize) -> usize {
        if rows < self.wide_block { self.imagine_block } else { self.wide_block }
    }
}

/// One time step of one row of a rollout.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct RowStep {
    /// The rollout.
    pub job: JobId,
    /// Row of the rollout, from 0.
    pub row: u32,
    /// Depth that the step reaches, from 1.
    pub depth: u32,
    /// Where the row's state lies.
    pub slot: u32,
}

/// What is computed in one tick.
#[derive(Debug, Default, PartialEq)]
pub struct Tick {
    /// Requests whose deadline has passed; they are forgotten.
    pub expired: Vec<JobId>,
    /// Observes with an image, to be computed first.
    pub seeing: Vec<Block<JobId>>,
    /// Observes without one, to be computed next.
    pub blind: Vec<Block<JobId>>,
    /// Steps of rollouts, to be computed last, in blocks of either size.
    pub imagine: Vec<Block<RowStep>>,
}

/// The state machine.
#[derive(Debug)]
pub struct Scheduler {
    sizes: Sizes,
    live: VecDeque<Observe>,
    bulk: VecDeque<Observe>,
    shares: Shares,
    /// Slots that hold no row.
    free: Vec<u32>,
}

#[derive(Debug)]
struct Observe {
    job: JobId,
    seeing: bool,
    lane: u64,
    deadline: Option<Instant>,
}

impl Scheduler {
    /// A scheduler with nothing to do.
    pub fn new(sizes: Sizes) -> Self {
        Self {
            sizes,
            live: VecDeque::new(),
            bulk: VecDeque::new(),
            shares: Shares::default(),
            free: (0..sizes.slots as u32).rev().collect(),
        }
    }

    /// Takes on an observe, with an image or without.
    pub fn observe(
        &mut self,
        job: JobId,
        (seeing, urgency): (bool, Urgency),
        lane: u64,
        deadline: Option<Instant>,
    ) {
        let observe = Observe { job, seeing, lane, deadline };
        match urgency {
            Urgency::Live => self.live.push_back(observe),
            Urgency::Bulk => self.bulk.push_back(observe),
        }
    }

    /// Takes on a rollout over `horizon` steps with a row in each of `lanes`; neither may be none.
    pub fn imagine(
        &mut self,
        job: JobId,
        tenant: Tenant,
        lanes: impl Iterator<Item = u64>,
        horizon: u32,
        deadline: Option<Instant>,
    ) {
        let lanes: Vec<u64> = lanes.collect();
        let block = self.sizes.block_for(lanes.len());
        self.shares.add(tenant, Rollout::new(job, (lanes, block), horizon, deadline));
    }

    /// Forgets a request, wherever it is.
    pub fn cancel(&mut self, job: JobId) {
        self.live.retain(|observe| observe.job != job);
        self.bulk.retain(|observe| observe.job != job);
        self.shares.cancel(job, &mut self.free);
    }

    /// Whether there is nothing to do.
    pub fn is_idle(&self) -> bool {
        self.live.is_empty() && self.bulk.is_empty() && self.shares.tenants() == 0
    }

    /// Whether a live observe waits in blocks, computed so many at once, that others could join.
    pub fn has_room(&self, blocks: usize) -> bool {
        let size = self.sizes.observe_block;
        size > 1 && (1..size * blocks).contains(&self.live.len())
    }

    /// Tenants that have rollouts.
    pub fn tenants(&self) -> usize {
        self.shares.tenants()
    }

    /// Whether there is work that takes the time of rollouts.
    pub fn is_rolling(&self) -> bool {
        !self.bulk.is_empty() || self.shares.tenants() > 0
    }

    /// Forms what is computed at `now`: all live observes, and about `blocks` blocks of bulk observes and rollout
    /// rows, half of them each where there is enough of both. A wide block counts as the others that would hold its rows,
    /// but there is always one for each of `workers`. What it names counts as computed; whoever cannot compute it cancels
    /// the request.
    pub fn tick(&mut self, now: Instant, blocks: usize, workers: usize) -> Tick {
        let expired = self.expire(now);
        let size = self.sizes.observe_block;
        let (mut seeing, mut blind) =
            (Blocks::new(size, usize::MAX), Blocks::new(size, usize::MAX));
        for observe in self.live.drain(..) {
            let blocks = if observe.seeing { &mut seeing } else { &mut blind };
            blocks.place(observe.lane, observe.job);
        }
        let live = seeing.count() + blind.count();
        let share = if self.shares.tenants() == 0 { blocks } else { blocks.div_ceil(2) };
        seeing.limit(seeing.count() + share);
        blind.limit(blind.count() + share);
        // Bulk observes fill lanes that would be padded before they open blocks.
        self.bulk.retain(|observe| {
            let blocks = if observe.seeing { &mut seeing } else { &mut blind };
            !blocks.place(observe.lane, observe.job)
        });
        let left = blocks.saturating_sub(seeing.count() + blind.count() - live).max(1);
        let Sizes { imagine_block, wide_block, slots, .. } = self.sizes;
        let wide = (left * imagine_block / wide_block).max(workers.min(left));
        let sizes = [(imagine_block, left), (wide_block, wide)];
        let imagine = self.shares.step(sizes, &mut self.free, slots);
        Tick { expired, seeing: seeing.into_open(), blind: blind.into_open(), imagine }
    }

    fn expire(&mut self, now: Instant) -> Vec<JobId> {
        let late = |deadline: Option<Instant>| deadline.is_some_and(|deadline| deadline <= now);
        let observes = self.live.iter().chain(&self.bulk).filter(|job| late(job.deadline));
        let rollouts = self.shares.rollouts().filter(|rollout| late(rollout.deadline));
        let expired: Vec<JobId> =
            observes.map(|job| job.job).chain(rollouts.map(|rollout| rollout.job)).collect();
        for job in &expired {
            self.cancel(*job);
        }
        expired
    }
}
