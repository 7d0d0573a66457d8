//! What is computed next: a pure state machine without threads or clock.
//!
//! Scheduling is iteration-level. At each tick every waiting observe and one time step of as many rollout rows as
//! fit are put into blocks; a row that is done makes room at the next tick, and rollouts that came meanwhile join.
//!
//! Blocks have fixed sizes, and a row's lane, its position in the block, follows from its request alone (seed and
//! row number), never from who else is there. Vectorised kernels treat the end of a tensor differently from its
//! beginning, so size and lane together are what makes a row's bytes independent of its neighbours: two rows that
//! want the same lane go into different blocks, and empty lanes are padded.
//!
//! The scheduler knows requests by number only; what they compute is [`super::executor`]'s business.

use std::{collections::VecDeque, time::Instant};

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
    /// Rows that can be on their way through rollouts at once.
    pub slots: usize,
}

/// Rows that are computed together; position is lane, and at least one lane is taken.
pub type Block<T> = Vec<Option<T>>;

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
    /// Steps of rollouts, to be computed last.
    pub imagine: Vec<Block<RowStep>>,
}

/// The state machine.
#[derive(Debug)]
pub struct Scheduler {
    sizes: Sizes,
    observes: VecDeque<Observe>,
    rollouts: VecDeque<Rollout>,
    free: Vec<u32>,
}

#[derive(Debug)]
struct Observe {
    job: JobId,
    seeing: bool,
    lane: u64,
    deadline: Option<Instant>,
}

#[derive(Debug)]
struct Rollout {
    job: JobId,
    rows: u32,
    horizon: u32,
    lane: u64,
    deadline: Option<Instant>,
    /// First row that has not started.
    next: u32,
    active: Vec<Active>,
}

#[derive(Debug)]
struct Active {
    row: u32,
    depth: u32,
    slot: u32,
    /// Whether it steps in the tick that is being formed.
    stepping: bool,
}

impl Scheduler {
    /// A scheduler with nothing to do.
    pub fn new(sizes: Sizes) -> Self {
        let free = (0..sizes.slots as u32).rev().collect();
        Self { sizes, observes: VecDeque::new(), rollouts: VecDeque::new(), free }
    }

    /// Takes on an observe, with an image or without.
    pub fn observe(&mut self, job: JobId, seeing: bool, lane: u64, deadline: Option<Instant>) {
        self.observes.push_back(Observe { job, seeing, lane, deadline });
    }

    /// Takes on a rollout of `rows` rows over `horizon` steps, both at least 1.
    pub fn imagine(
        &mut self,
        job: JobId,
        (rows, horizon): (u32, u32),
        lane: u64,
        deadline: Option<Instant>,
    ) {
        self.rollouts.push_back(Rollout {
            job,
            rows,
            horizon,
            lane,
            deadline,
            next: 0,
            active: Vec::new(),
        });
    }

    /// Forgets a request, wherever it is.
    pub fn cancel(&mut self, job: JobId) {
        self.observes.retain(|observe| observe.job != job);
        let Self { rollouts, free, .. } = self;
        rollouts.retain(|rollout| {
            if rollout.job == job {
                free.extend(rollout.active.iter().map(|active| active.slot));
            }
            rollout.job != job
        });
    }

    /// Whether there is nothing to do.
    pub fn is_idle(&self) -> bool {
        self.observes.is_empty() && self.rollouts.is_empty()
    }

    /// Forms what is computed at `now`: all observes, and at most `imagine_blocks` blocks of rollout rows. What it
    /// names counts as computed; whoever cannot compute it cancels the request.
    pub fn tick(&mut self, now: Instant, imagine_blocks: usize) -> Tick {
        let expired = self.expire(now);
        let size = self.sizes.observe_block;
        let (mut seeing, mut blind) =
            (Blocks::new(size, usize::MAX), Blocks::new(size, usize::MAX));
        for observe in self.observes.drain(..) {
            let blocks = if observe.seeing { &mut seeing } else { &mut blind };
            blocks.place(observe.lane, observe.job);
        }
        let imagine = self.step_rollouts(Blocks::new(self.sizes.imagine_block, imagine_blocks));
        Tick { expired, seeing: seeing.open, blind: blind.open, imagine }
    }

    fn expire(&mut self, now: Instant) -> Vec<JobId> {
        let late = |deadline: Option<Instant>| deadline.is_some_and(|deadline| deadline <= now);
        let observes = self.observes.iter().filter(|job| late(job.deadline)).map(|job| job.job);
        let rollouts = self.rollouts.iter().filter(|job| late(job.deadline)).map(|job| job.job);
        let expired: Vec<JobId> = observes.chain(rollouts).collect();
        for job in &expired {
            self.cancel(*job);
        }
        expired
    }

    /// Rollouts share the blocks evenly, and what one leaves the others take. The next tick begins with another
    /// rollout, so that rounding favours none.
    fn step_rollouts(&mut self, mut blocks: Blocks<RowStep>) -> Vec<Block<RowStep>> {
        if self.rollouts.is_empty() {
            return Vec::new();
        }
        let share = (blocks.capacity() / self.rollouts.len()).max(1);
        for rows in [share, usize::MAX] {
            for rollout in &mut self.rollouts {
                rollout.step(rows, &mut blocks, &mut self.free);
            }
        }
        for rollout in &mut self.rollouts {
            rollout.advance(&mut self.free);
        }
        self.rollouts.retain(|rollout| !rollout.is_done());
        if !self.rollouts.is_empty() {
            self.rollouts.rotate_left(1);
        }
        blocks.open
    }
}

impl Rollout {
    /// Puts up to `most` rows that do not step yet into blocks: those on their way first, so that few rows hold
    /// states at once, then rows that start.
    fn step(&mut self, most: usize, blocks: &mut Blocks<RowStep>, free: &mut Vec<u32>) {
        let mut left = most;
        for active in self.active.iter_mut().filter(|active| !active.stepping) {
            if left == 0 || blocks.is_full() {
                return;
            }
            let Active { row, depth, slot, .. } = *active;
            let step = RowStep { job: self.job, row, depth: depth + 1, slot };
            active.stepping = blocks.place(self.lane.wrapping_add(u64::from(row)), step);
            left -= usize::from(active.stepping);
        }
        while left > 0 && self.next < self.rows {
            let Some(&slot) = free.last() else { return };
            let row = self.next;
            let step = RowStep { job: self.job, row, depth: 1, slot };
            if !blocks.place(self.lane.wrapping_add(u64::from(row)), step) {
                return;
            }
            free.pop();
            self.active.push(Active { row, depth: 0, slot, stepping: true });
            self.next += 1;
            left -= 1;
        }
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
        self.next == self.rows && self.active.is_empty()
    }
}

/// Blocks that are being filled.
struct Blocks<T> {
    open: Vec<Block<T>>,
    size: usize,
    most: usize,
    taken: usize,
}

impl<T: Copy> Blocks<T> {
    fn new(size: usize, most: usize) -> Self {
        Self { open: Vec::new(), size, most, taken: 0 }
    }

    fn capacity(&self) -> usize {
        self.size.saturating_mul(self.most)
    }

    fn is_full(&self) -> bool {
        self.taken >= self.capacity()
    }

    /// Puts a row into the first block whose lane is free; false if there is none.
    fn place(&mut self, lane: u64, row: T) -> bool {
        let lane = (lane % self.size as u64) as usize;
        let at = match self.open.iter().position(|block| block[lane].is_none()) {
            Some(at) => at,
            None if self.open.len() < self.most => {
                self.open.push(vec![None; self.size]);
                self.open.len() - 1
            }
            None => return false,
        };
        self.open[at][lane] = Some(row);
        self.taken += 1;
        true
    }
}

#[cfg(test)]
mod tests {
    use std::{collections::BTreeMap, time::Duration};

    use proptest::prelude::*;

    use super::*;

    const SIZES: Sizes = Sizes { observe_block: 2, imagine_block: 4, slots: 16 };

    fn steps(tick: &Tick) -> Vec<(u64, u32, u32)> {
        let steps = tick.imagine.iter().flatten().flatten();
        steps.map(|step| (step.job.0, step.row, step.depth)).collect()
    }

    #[test]
    fn all_observes_go_at_once_images_apart() {
        let (mut scheduler, now) = (Scheduler::new(SIZES), Instant::now());
        for (job, seeing, lane) in
            [(0, true, 0), (1, false, 4), (2, true, 1), (3, true, 2), (4, true, 6)]
        {
            scheduler.observe(JobId(job), seeing, lane, None);
        }
        let tick = scheduler.tick(now, 1);
        let job = |id: u64| Some(JobId(id));
        assert_eq!(
            tick.seeing,
            [vec![job(0), job(2)], vec![job(3), None], vec![job(4), None]],
            "even lanes are the first"
        );
        assert_eq!(tick.blind, [vec![job(1), None]]);
        assert!(scheduler.is_idle());
    }

    #[test]
    fn a_rollout_keeps_few_rows_on_their_way() {
        let (mut scheduler, now) = (Scheduler::new(SIZES), Instant::now());
        scheduler.imagine(JobId(7), (6, 2), 0, None);
        assert_eq!(steps(&scheduler.tick(now, 1)), [(7, 0, 1), (7, 1, 1), (7, 2, 1), (7, 3, 1)]);
        assert_eq!(steps(&scheduler.tick(now, 1)), [(7, 0, 2), (7, 1, 2), (7, 2, 2), (7, 3, 2)]);
        assert_eq!(steps(&scheduler.tick(now, 1)), [(7, 4, 1), (7, 5, 1)]);
        assert!(!scheduler.is_idle());
        assert_eq!(steps(&scheduler.tick(now, 1)), [(7, 4, 2), (7, 5, 2)]);
        assert!(scheduler.is_idle());
    }

    #[test]
    fn whoever_comes_later_joins_at_the_next_tick() {
        let (mut scheduler, now) = (Scheduler::new(SIZES), Instant::now());
        scheduler.imagine(JobId(1), (8, 3), 0, None);
        scheduler.tick(now, 1);
        scheduler.imagine(JobId(2), (2, 1), 2, None);
        let tick = scheduler.tick(now, 1);
        assert_eq!(steps(&tick), [(1, 0, 2), (1, 1, 2), (2, 0, 1), (2, 1, 1)]);
        // What the second left is taken by the first again, each row at its own depth.
        let tick = scheduler.tick(now, 2);
        assert_eq!(
            steps(&tick),
            [
                (1, 0, 3),
                (1, 1, 3),
                (1, 2, 2),
                (1, 3, 2),
                (1, 4, 1),
                (1, 5, 1),
                (1, 6, 1),
                (1, 7, 1)
            ]
        );
    }

    #[test]
    fn deadlines_end_what_waits_and_what_is_under_way() {
        let (mut scheduler, now) = (Scheduler::new(SIZES), Instant::now());
        let soon = now + Duration::from_millis(5);
        scheduler.imagine(JobId(1), (4, 9), 0, Some(soon));
        assert_eq!(scheduler.tick(now, 1).expired, []);
        scheduler.observe(JobId(2), true, 0, Some(soon));
        let tick = scheduler.tick(soon, 1);
        assert_eq!(tick.expired, [JobId(2), JobId(1)]);
        assert_eq!((tick.seeing, tick.imagine), (Vec::new(), Vec::new()));
        assert!(scheduler.is_idle() && scheduler.free.len() == SIZES.slots);
    }

    /// What may happen to a scheduler.
    #[derive(Clone, Debug)]
    enum Event {
        Observe { seeing: bool, lane: u64 },
        Imagine { rows: u32, horizon: u32, lane: u64 },
        Cancel { which: usize },
        Tick { blocks: usize },
    }

    fn event() -> impl Strategy<Value = Event> {
        prop_oneof![
            (any::<bool>(), any::<u64>())
                .prop_map(|(seeing, lane)| Event::Observe { seeing, lane }),
            (1..20u32, 1..6u32, any::<u64>()).prop_map(|(rows, horizon, lane)| Event::Imagine {
                rows,
                horizon,
                lane
            }),
            (0..8usize).prop_map(|which| Event::Cancel { which }),
            (1..4usize).prop_map(|blocks| Event::Tick { blocks }),
            (1..4usize).prop_map(|blocks| Event::Tick { blocks }),
        ]
    }

    /// A rollout as the test knows it.
    struct Known {
        rows: u32,
        horizon: u32,
        lane: u64,
        depths: BTreeMap<u32, (u32, u32)>,
    }

    proptest! {
        /// Every row takes every step once and in order, in its lane and in a slot that nobody else has; observes
        /// never wait; no tick is larger than it may be; and in the end nothing is left.
        #[test]
        fn every_step_happens_once_in_its_lane(
            events in proptest::collection::vec(event(), 1..60),
            imagine_block in 1..6usize,
            observe_block in 1..4usize,
            slots in 6..20usize,
        ) {
            let sizes = Sizes { observe_block, imagine_block, slots };
            let (mut scheduler, now) = (Scheduler::new(sizes), Instant::now());
            let mut rollouts: BTreeMap<JobId, Known> = BTreeMap::new();
            let mut observes: BTreeMap<JobId, (bool, u64)> = BTreeMap::new();
            let drain = std::iter::repeat_n(Event::Tick { blocks: 2 }, 3000);
            for (id, event) in events.into_iter().chain(drain).enumerate() {
                let id = JobId(id as u64);
                match event {
                    Event::Observe { seeing, lane } => {
                        scheduler.observe(id, seeing, lane, None);
                        observes.insert(id, (seeing, lane));
                    }
                    Event::Imagine { rows, horizon, lane } => {
                        scheduler.imagine(id, (rows, horizon), lane, None);
                        rollouts.insert(id, Known { rows, horizon, lane, depths: BTreeMap::new() });
                    }
                    Event::Cancel { which } => {
                        let jobs = rollouts.keys().chain(observes.keys());
                        if let Some(&job) = jobs.into_iter().nth(which) {
                            scheduler.cancel(job);
                            rollouts.remove(&job);
                            observes.remove(&job);
                        }
                    }
                    Event::Tick { blocks } => {
                        let tick = scheduler.tick(now, blocks);
                        for (block, seeing) in tick.seeing.iter().map(|block| (block, true))
                            .chain(tick.blind.iter().map(|block| (block, false)))
                        {
                            prop_assert_eq!(block.len(), observe_block);
                            prop_assert!(block.iter().any(Option::is_some));
                            for (lane, job) in block.iter().enumerate() {
                                let Some(job) = job else { continue };
                                let known = observes.remove(job).unwrap();
                                prop_assert_eq!(known.0, seeing);
                                prop_assert_eq!(known.1 % observe_block as u64, lane as u64);
                            }
                        }
                        prop_assert!(observes.is_empty(), "an observe waits");
                        prop_assert!(tick.imagine.len() <= blocks);
                        prop_assert!(rollouts.is_empty() || !tick.imagine.is_empty(), "nothing moves");
                        let mut taken = std::collections::BTreeSet::new();
                        for block in &tick.imagine {
                            prop_assert_eq!(block.len(), imagine_block);
                            prop_assert!(block.iter().any(Option::is_some));
                            for (lane, step) in block.iter().enumerate() {
                                let Some(step) = step else { continue };
                                let known = rollouts.get_mut(&step.job).unwrap();
                                let right = known.lane.wrapping_add(step.row.into());
                                prop_assert_eq!(right % imagine_block as u64, lane as u64);
                                let (depth, slot) = known.depths.get(&step.row).copied().unwrap_or((0, step.slot));
                                prop_assert_eq!((step.depth, step.slot), (depth + 1, slot));
                                known.depths.insert(step.row, (step.depth, step.slot));
                                prop_assert!(step.row < known.rows && step.depth <= known.horizon);
                                prop_assert!((step.slot as usize) < slots && taken.insert(step.slot));
                            }
                        }
                        for known in rollouts.values() {
                            let under_way = known.depths.values().filter(|(depth, _)| *depth < known.horizon);
                            for (_, slot) in under_way {
                                prop_assert!(!scheduler.free.contains(slot), "a slot is free and taken");
                            }
                        }
                        rollouts.retain(|_, known| {
                            let done = known.depths.values().filter(|(depth, _)| *depth == known.horizon);
                            (done.count() as u32) < known.rows
                        });
                    }
                }
            }
            prop_assert!(scheduler.is_idle());
            prop_assert_eq!(scheduler.free.len(), slots);
        }
    }
}
