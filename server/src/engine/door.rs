//! The engine's door: how much work is let in, and what those are told who are not.
//!
//! Everything behind the door is bounded: observes that wait, rows of rollouts, bytes of outputs that nobody has
//! fetched. Work is predicted from what blocks were measured to cost: what cannot be done by its deadline is refused
//! at once, with the estimate, and what finds no room gets a retry hint from the work that is ahead of it. Bulk work
//! has room of its own, and waits for it outside.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use parking_lot::Mutex;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::{
    gauges::{Gauges, Waiting},
    models::{Cost, Costs},
    scheduler::Sizes,
};
use crate::error::Error;

/// How long estimates may refuse work without new measurements; then one request is let in to measure again.
const STALE: Duration = Duration::from_secs(10);

/// How much is let in.
#[derive(Clone, Copy, Debug)]
pub struct DoorSizes {
    /// Observes that wait or are computed.
    pub observes: usize,
    /// Rows of all rollouts; bulk ones have half as much besides.
    pub rows: usize,
    /// Bytes of outputs of all rollouts that are computed or wait to be fetched; bulk ones have half as much besides.
    pub output_bytes: u64,
}

/// The door.
#[derive(Debug)]
pub(super) struct Door {
    live: Room,
    bulk: Room,
    /// Predicted time of all that is let in and not computed, in nanoseconds.
    ahead: AtomicU64,
    /// The same of live observes, which go first.
    observing: AtomicU64,
    /// Tenants that have rollouts.
    tenants: AtomicU64,
    measured: Mutex<Instant>,
    sizes: Sizes,
    /// Blocks that are computed at once.
    workers: u32,
    pub(super) gauges: Gauges,
}

/// Room for work of one urgency.
#[derive(Debug)]
struct Room {
    observes: Arc<Semaphore>,
    rows: Arc<Semaphore>,
    /// How much room for observes and rows there is when nobody is here.
    all: [usize; 2],
    /// In KiB, since a semaphore counts no further than 32 bits at once.
    outputs: Arc<Semaphore>,
}

/// What is to be let in: a rollout of rows over steps that gives outputs.
#[derive(Clone, Copy, Debug)]
pub(super) struct Load {
    pub(super) rows: u32,
    pub(super) steps: u32,
    pub(super) output_bytes: u64,
    pub(super) deadline: Option<Instant>,
}

/// Room behind the door; given back on drop.
#[derive(Debug)]
pub(super) struct Ticket {
    door: Arc<Door>,
    /// Row steps that are still to be computed, and their predicted time.
    row_steps: u64,
    nanos: u64,
    live_observe: bool,
    _permit: OwnedSemaphorePermit,
}

impl Door {
    pub(super) fn new(door: DoorSizes, sizes: Sizes, workers: usize) -> Self {
        let room = |part: usize| {
            let share = |all: usize| (all / part).max(1);
            let semaphore = |all: usize| Arc::new(Semaphore::new(share(all)));
            Room {
                observes: semaphore(door.observes),
                rows: semaphore(door.rows),
                all: [share(door.observes), share(door.rows)],
                outputs: semaphore(kib(door.output_bytes) as usize),
            }
        };
        Self {
            live: room(1),
            bulk: room(2),
            ahead: AtomicU64::new(0),
            observing: AtomicU64::new(0),
            tenants: AtomicU64::new(0),
            measured: Mutex::new(Instant::now()),
            sizes,
            workers: workers.max(1) as u32,
            gauges: Gauges::default(),
        }
    }

    /// What is let in and not answered.
    pub(super) fn waiting(&self) -> Waiting {
        let taken = |Room { observes, rows, all, .. }: &Room| {
            [all[0] - observes.available_permits(), all[1] - rows.available_permits()]
        };
        let (live, bulk) = (taken(&self.live), taken(&self.bulk));
        let [observes, rows] = [0, 1].map(|at| (live[at] + bulk[at]) as u64);
        Waiting { observes, rows, time: nanos(&self.ahead) }
    }

    /// Room for an observe that somebody waits for.
    pub(super) fn admit_observe(
        self: &Arc<Self>,
        costs: &Costs,
        deadline: Option<Instant>,
    ) -> Result<Ticket, Error> {
        let own = self.observe_cost(costs);
        let before = nanos(&self.observing);
        // Where nothing is ahead, trying costs nobody anything.
        if !before.is_zero() {
            self.in_time(before + own, own, deadline)?;
        }
        let Ok(permit) = Arc::clone(&self.live.observes).try_acquire_owned() else {
            return Err(overloaded("observations wait", before));
        };
        Ok(self.ticket(1, own / self.workers, true, permit))
    }

    /// Room for an observe that is one of many; waits for it.
    pub(super) async fn admit_bulk_observe(
        self: &Arc<Self>,
        costs: &Costs,
    ) -> Result<Ticket, Error> {
        let permit = Arc::clone(&self.bulk.observes).acquire_owned().await;
        let permit = permit.map_err(|_closed| Error::ShuttingDown)?;
        Ok(self.ticket(1, self.observe_cost(costs) / self.workers, false, permit))
    }

    /// Room for a rollout; the second part is held by whoever fetches its outputs.
    pub(super) fn admit_rollout(
        self: &Arc<Self>,
        costs: &Costs,
        load: Load,
    ) -> Result<(Ticket, OwnedSemaphorePermit), Error> {
        let [own, share] = self.rollout_cost(costs, load);
        let ahead = nanos(&self.ahead);
        // Tenants share the model evenly, and nobody waits longer than all work takes.
        let tenants = 1 + self.tenants.load(Ordering::Relaxed) as u32;
        let needs = (ahead + own).min(own * tenants + nanos(&self.observing));
        self.in_time(needs, own, load.deadline)?;
        let outputs = Arc::clone(&self.live.outputs).try_acquire_many_owned(kib(load.output_bytes));
        let Ok(outputs) = outputs else {
            return Err(overloaded("outputs of rollouts wait to be fetched", ahead));
        };
        let Ok(permit) = Arc::clone(&self.live.rows).try_acquire_many_owned(load.rows) else {
            return Err(overloaded("rows of rollouts wait", ahead));
        };
        Ok((self.ticket(load.row_steps(), share, false, permit), outputs))
    }

    /// Room for a rollout that is one of many; waits for it.
    pub(super) async fn admit_bulk_rollout(
        self: &Arc<Self>,
        costs: &Costs,
        load: Load,
    ) -> Result<(Ticket, OwnedSemaphorePermit), Error> {
        let closed = |_closed| Error::ShuttingDown;
        let outputs = Arc::clone(&self.bulk.outputs).acquire_many_owned(kib(load.output_bytes));
        let outputs = outputs.await.map_err(closed)?;
        let permit = Arc::clone(&self.bulk.rows).acquire_many_owned(load.rows);
        let permit = permit.await.map_err(closed)?;
        let [_, share] = self.rollout_cost(costs, load);
        Ok((self.ticket(load.row_steps(), share, false, permit), outputs))
    }

    /// The most that a bulk rollout may be, in rows and bytes of outputs.
    pub(super) fn bulk_limit(sizes: DoorSizes) -> (u32, u64) {
        (((sizes.rows / 2).max(1)) as u32, sizes.output_bytes / 2)
    }

    /// Remembers what a block cost.
    pub(super) fn measured(&self, cost: &Cost, rows: usize, elapsed: Duration) {
        cost.measured(rows, elapsed);
        *self.measured.lock() = Instant::now();
    }

    /// Remembers how many tenants have rollouts.
    pub(super) fn shared_by(&self, tenants: usize) {
        self.tenants.store(tenants as u64, Ordering::Relaxed);
    }

    /// Refuses what cannot be done by its deadline; where that is only because of other work, later may be better.
    fn in_time(
        &self,
        needs: Duration,
        own: Duration,
        deadline: Option<Instant>,
    ) -> Result<(), Error> {
        let Some(within) = deadline.map(|at| at.saturating_duration_since(Instant::now())) else {
            return Ok(());
        };
        if needs <= within || self.is_stale() {
            return Ok(());
        }
        let retry_after = (own <= within).then(|| needs.saturating_sub(own));
        Err(Error::TooSlow { needs, within, retry_after })
    }

    /// Whether nothing was measured for long; says so once in that time.
    fn is_stale(&self) -> bool {
        let mut measured = self.measured.lock();
        let stale = measured.elapsed() > STALE;
        if stale {
            *measured = Instant::now();
        }
        stale
    }

    fn observe_cost(&self, costs: &Costs) -> Duration {
        costs.observe.full() / self.sizes.observe_block as u32
    }

    /// How long a rollout takes alone, and its part of the time that workers have together.
    fn rollout_cost(&self, costs: &Costs, load: Load) -> [Duration; 2] {
        let rows = load.rows as usize;
        let lanes = self.sizes.block_for(rows);
        let cost = costs.of_imagine(lanes);
        let full = cost.full().saturating_mul((rows / lanes) as u32);
        let rest = rows % lanes;
        let rest = if rest > 0 { cost.of(rest) } else { Duration::ZERO };
        let work = full.saturating_add(rest).saturating_mul(load.steps);
        let at_once = self.workers.min(rows.div_ceil(lanes).max(1) as u32);
        [at_once, self.workers].map(|workers| work / workers)
    }

    fn ticket(
        self: &Arc<Self>,
        row_steps: u64,
        share: Duration,
        live_observe: bool,
        permit: OwnedSemaphorePermit,
    ) -> Ticket {
        let nanos = share.as_nanos() as u64;
        self.ahead.fetch_add(nanos, Ordering::Relaxed);
        if live_observe {
            self.observing.fetch_add(nanos, Ordering::Relaxed);
        }
        Ticket { door: Arc::clone(self), row_steps, nanos, live_observe, _permit: permit }
    }
}

impl Load {
    fn row_steps(self) -> u64 {
        u64::from(self.rows) * u64::from(self.steps)
    }
}

impl Ticket {
    /// Counts row steps as computed.
    pub(super) fn done(&mut self, row_steps: u64) {
        let left = self.row_steps - row_steps;
        let nanos = if left == 0 {
            self.nanos
        } else {
            let share = u128::from(self.nanos) * u128::from(row_steps);
            (share / u128::from(self.row_steps)) as u64
        };
        self.row_steps = left;
        self.give_back(nanos);
    }

    fn give_back(&mut self, nanos: u64) {
        self.nanos -= nanos;
        self.door.ahead.fetch_sub(nanos, Ordering::Relaxed);
        if self.live_observe {
            self.door.observing.fetch_sub(nanos, Ordering::Relaxed);
        }
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        self.give_back(self.nanos);
    }
}

fn nanos(counter: &AtomicU64) -> Duration {
    Duration::from_nanos(counter.load(Ordering::Relaxed))
}

fn overloaded(what: &'static str, ahead: Duration) -> Error {
    Error::Overloaded { what, retry_after: ahead.max(Duration::from_millis(1)) }
}

fn kib(bytes: u64) -> u32 {
    u32::try_from(bytes.div_ceil(1024)).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn millis(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    fn door(observes: usize) -> (Arc<Door>, Costs) {
        let door = DoorSizes { observes, rows: 10, output_bytes: 8 << 10 };
        let sizes = Sizes { observe_block: 1, imagine_block: 4, wide_block: 9, slots: 8 };
        let costs = Costs {
            observe: Cost::new(millis(5), millis(5), 1),
            imagine: Cost::new(millis(8), millis(8), 4),
            wide: Cost::new(millis(12), millis(12), 9),
        };
        (Arc::new(Door::new(door, sizes, 1)), costs)
    }

    fn load(rows: u32, steps: u32, output_bytes: u64) -> Load {
        Load { rows, steps, output_bytes, deadline: None }
    }

    #[test]
    fn what_is_let_in_is_bounded_and_given_back() {
        let (door, costs) = door(1);
        let observe = door.admit_observe(&costs, None).unwrap();
        let refused = door.admit_observe(&costs, None).unwrap_err();
        assert_eq!(refused.retry_after(), Some(millis(5)));
        drop(observe);
        door.admit_observe(&costs, None).unwrap();

        let (mut ticket, outputs) = door.admit_rollout(&costs, load(8, 5, 8 << 10)).unwrap();
        let refused = door.admit_rollout(&costs, load(1, 1, 1)).unwrap_err();
        assert_eq!(refused.retry_after(), Some(millis(80)), "two blocks over five steps");
        ticket.done(30);
        drop(outputs);
        let refused = door.admit_rollout(&costs, load(8, 1, 1)).unwrap_err();
        assert_eq!(refused.retry_after(), Some(millis(20)));
        drop(ticket);
        assert_eq!(door.ahead.load(Ordering::Relaxed), 0);
        drop(door.admit_rollout(&costs, load(8, 1, 8 << 10)).unwrap());
    }

    #[test]
    fn what_cannot_be_done_in_time_is_refused_with_the_estimate() {
        let (door, costs) = door(4);
        let within = |millis: u64, rows: u32, steps: u32| {
            let deadline = Some(Instant::now() + Duration::from_millis(millis));
            door.admit_rollout(&costs, Load { deadline, ..load(rows, steps, 1) })
        };
        match within(100, 8, 10).unwrap_err() {
            Error::TooSlow { needs, within, retry_after } => {
                assert_eq!((needs, retry_after), (millis(160), None), "however long it waited");
                assert!(within <= millis(100));
            }
            error => panic!("{error}"),
        }
        let error = within(100, 9, 10).unwrap_err();
        let one_wide = |needs| needs == millis(120);
        assert!(matches!(error, Error::TooSlow { needs, .. } if one_wide(needs)), "{error}");
        let (first, _outputs) = within(200, 8, 10).unwrap();
        // Alone it would be in time; behind the first one, of another tenant, it would not.
        door.shared_by(1);
        match within(100, 2, 10).unwrap_err() {
            Error::TooSlow { needs, retry_after, .. } => {
                assert_eq!((needs, retry_after), (millis(160), Some(millis(80))));
            }
            error => panic!("{error}"),
        }
        drop(first);
        door.shared_by(0);
        drop(within(100, 2, 10).unwrap());
    }

    #[test]
    fn an_observation_is_refused_only_for_what_is_ahead_of_it() {
        let (door, costs) = door(4);
        let soon = Some(Instant::now() + millis(2));
        let first = door.admit_observe(&costs, soon).unwrap();
        let error = door.admit_observe(&costs, soon).unwrap_err();
        assert!(matches!(error, Error::TooSlow { needs, .. } if needs == millis(10)), "{error}");
        drop(first);
        door.admit_observe(&costs, soon).unwrap();
    }

    #[tokio::test]
    async fn bulk_work_waits_and_takes_no_room_from_live_work() {
        let (door, costs) = door(4);
        let (bulk, _outputs) = door.admit_bulk_rollout(&costs, load(5, 1, 1)).await.unwrap();
        let waiting = tokio::spawn({
            let (door, costs) =
                (Arc::clone(&door), Costs { observe: Cost::new(millis(5), millis(5), 1), ..costs });
            async move { door.admit_bulk_rollout(&costs, load(1, 1, 1)).await.map(drop) }
        });
        tokio::task::yield_now().await;
        assert!(!waiting.is_finished());
        let costs = Costs {
            observe: Cost::new(millis(5), millis(5), 1),
            imagine: Cost::new(millis(8), millis(8), 4),
            wide: Cost::new(millis(12), millis(12), 9),
        };
        drop(door.admit_rollout(&costs, load(10, 1, 1)).unwrap());
        drop(bulk);
        waiting.await.unwrap().unwrap();
        assert_eq!(door.ahead.load(Ordering::Relaxed), 0);
    }
}
