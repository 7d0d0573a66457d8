//! The rollouts that are on their way, and how tenants share the blocks.

use std::{collections::VecDeque, time::Instant};

use super::{
    JobId, RowStep,
    blocks::{Block, Blocks},
};
use crate::engine::commands::Tenant;

/// Everybody's rollouts.
#[derive(Debug, Default)]
pub(super) struct Shares {
    shares: VecDeque<Share>,
}

/// One tenant's rollouts; never none.
#[derive(Debug)]
struct Share {
    tenant: Tenant,
    rollouts: VecDeque<Rollout>,
}

#[derive(Debug)]
pub(super) struct Rollout {
    pub(super) job: JobId,
    pub(super) deadline: Option<Instant>,
    horizon: u32,
    /// Rows of the blocks in which it is computed.
    block: usize,
    /// What the lane of each row follows from.
    lanes: Vec<u64>,
    /// Rows that have not started, in order.
    waiting: VecDeque<u32>,
    active: Vec<Active>,
}

/// A row on its way.
#[derive(Debug)]
struct Active {
    row: u32,
    depth: u32,
    slot: u32,
    /// Whether it steps in the tick that is being formed.
    stepping: bool,
}

impl Shares {
    pub(super) fn add(&mut self, tenant: Tenant, rollout: Rollout) {
        match self.shares.iter_mut().find(|share| share.tenant == tenant) {
            Some(share) => share.rollouts.push_back(rollout),
            None => self.shares.push_back(Share { tenant, rollouts: [rollout].into() }),
        }
    }

    pub(super) fn tenants(&self) -> usize {
        self.shares.len()
    }

    pub(super) fn rollouts(&self) -> impl Iterator<Item = &Rollout> {
        self.shares.iter().flat_map(|share| &share.rollouts)
    }

    pub(super) fn cancel(&mut self, job: JobId, free: &mut Vec<u32>) {
        self.retain(|rollout| {
            if rollout.job == job {
                free.extend(rollout.active.iter().map(|active| active.slot));
            }
            rollout.job != job
        });
    }

    /// Steps of rollouts in blocks of both `sizes`, rows and how many blocks there may be.
    ///
    /// Tenants share the blocks evenly, and what one leaves the others take. The next tick begins with another tenant, and
    /// with another of its rollouts, so that neither rounding nor a lane that two want favours any. Of `slots` a tenant
    /// holds so few that one more tenant finds its share.
    pub(super) fn step(
        &mut self,
        sizes: [(usize, usize); 2],
        free: &mut Vec<u32>,
        slots: usize,
    ) -> Vec<Block<RowStep>> {
        if self.shares.is_empty() {
            return Vec::new();
        }
        let mut blocks = self.blocks(sizes);
        let capacity: usize = blocks.iter().map(Blocks::capacity).sum();
        let share = (capacity / self.shares.len()).max(1);
        let most_slots = (slots / (self.shares.len() + 1)).max(1);
        for most in [share, usize::MAX] {
            for tenant in &mut self.shares {
                tenant.step(most, most_slots, &mut blocks, free);
            }
        }
        for rollout in self.shares.iter_mut().flat_map(|share| &mut share.rollouts) {
            rollout.advance(free);
        }
        self.retain(|rollout| !rollout.is_done());
        for share in &mut self.shares {
            share.rollouts.rotate_left(1);
        }
        if !self.shares.is_empty() {
            self.shares.rotate_left(1);
        }
        blocks.into_iter().flat_map(Blocks::into_open).collect()
    }

    /// Blocks of each size in which there are rollouts, which share the time evenly.
    fn blocks(&self, sizes: [(usize, usize); 2]) -> Vec<Blocks<RowStep>> {
        let used = |size: usize| self.rollouts().any(|rollout| rollout.block == size);
        let [narrow, wide] = sizes;
        let sizes = if narrow.0 == wide.0 { vec![narrow] } else { vec![wide, narrow] };
        let sizes: Vec<_> = sizes.into_iter().filter(|(size, _)| used(*size)).collect();
        let each = |most: usize| most.div_ceil(sizes.len());
        sizes.iter().map(|(size, most)| Blocks::new(*size, each(*most))).collect()
    }

    fn retain(&mut self, mut keep: impl FnMut(&Rollout) -> bool) {
        for share in &mut self.shares {
            share.rollouts.retain(&mut keep);
        }
        self.shares.retain(|share| !share.rollouts.is_empty());
    }
}

impl Share {
    /// Puts up to `most` rows into blocks, the tenant's rollouts side by side.
    fn step(
        &mut self,
        most: usize,
        most_slots: usize,
        blocks: &mut [Blocks<RowStep>],
        free: &mut Vec<u32>,
    ) {
        let (mut left, each) = (most, (most / self.rollouts.len()).max(1));
        let mut held: usize = self.rollouts.iter().map(|rollout| rollout.active.len()).sum();
        for rows in [each, usize::MAX] {
            for rollout in &mut self.rollouts {
                let before = rollout.active.len();
                let starts = most_slots.saturating_sub(held);
                let blocks = blocks.iter_mut().find(|blocks| blocks.size() == rollout.block);
                let blocks = blocks.expect("there are blocks of every size that is used");
                left -= rollout.step(rows.min(left), starts, blocks, free);
                held += rollout.active.len() - before;
            }
        }
    }
}

impl Rollout {
    pub(super) fn new(
        job: JobId,
        (lanes, block): (Vec<u64>, usize),
        horizon: u32,
        deadline: Option<Instant>,
    ) -> Self {
        let waiting = (0..lanes.len() as u32).collect();
        Self { job, deadline, horizon, block, lanes, waiting, active: Vec::new() }
    }

    /// Puts up to `most` rows that do not step yet into blocks: those on their way first, so that few rows hold
    /// states at once, then up to `starts` rows that start. Returns how many.
    fn step(
        &mut self,
        most: usize,
        starts: usize,
        blocks: &mut Blocks<RowStep>,
        free: &mut Vec<u32>,
    ) -> usize {
        let mut placed = 0;
        for active in self.active.iter_mut().filter(|active| !active.stepping) {
            if placed == most || blocks.is_full() {
                return placed;
            }
            let Active { row, depth, slot, .. } = *active;
            let step = RowStep { job: self.job, row, depth: depth + 1, slot };
            active.stepping = blocks.place(self.lanes[row as usize], step);
            placed += usize::from(active.stepping);
        }
        let most = most.min(placed.saturating_add(starts));
        let mut passed_over = Vec::new();
        while placed < most && !blocks.is_full() {
            let Some(&slot) = free.last() else { break };
            let Some(row) = self.waiting.pop_front() else { break };
            let step = RowStep { job: self.job, row, depth: 1, slot };
            if blocks.place(self.lanes[row as usize], step) {
                free.pop();
                self.active.push(Active { row, depth: 0, slot, stepping: true });
                placed += 1;
            } else {
                passed_over.push(row);
            }
        }
        for row in passed_over.into_iter().rev() {
            self.waiting.push_front(row);
        }
        placed
    }

    /// Counts the steps of the tick and gives back the slots of rows that are done.
    fn advance(&mut self, free: &mut Vec<u32>) {
        self.active.retain_mut(|active| {
            active.depth += u32::from(std::mem::take(&mut active.stepping));
            if active.depth == self.horizon {
                free.push(active.slot);
            }
            active.depth < self.horizon
        });
    }

    fn is_done(&self) -> bool {
        self.waiting.is_empty() && self.active.is_empty()
    }
}
