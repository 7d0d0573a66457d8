//! The engine's door: how much work is let in, and what those are told who are not.
//!
//! Everything behind the door is bounded: observes that wait, rows of rollouts, bytes of outputs that nobody has
//! fetched. What is refused gets a retry hint from the work ahead of it at the pace that was last measured.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::error::Error;

/// How much is let in.
#[derive(Clone, Copy, Debug)]
pub struct DoorSizes {
    /// Observes that wait or are computed.
    pub observes: usize,
    /// Rows of all rollouts.
    pub rows: usize,
    /// Bytes of outputs of all rollouts that are computed or wait to be fetched.
    pub output_bytes: u64,
}

/// The door.
#[derive(Debug)]
pub(super) struct Door {
    observes: Arc<Semaphore>,
    rows: Arc<Semaphore>,
    /// In KiB, since a semaphore counts no further than 32 bits at once.
    outputs: Arc<Semaphore>,
    /// Row steps of rollouts that are still to be computed.
    ahead: AtomicU64,
    /// Measured cost of a row step and of an observe, in nanoseconds.
    row_nanos: AtomicU64,
    observe_nanos: AtomicU64,
    sizes: DoorSizes,
}

/// Room behind the door; given back on drop.
#[derive(Debug)]
pub(super) struct Ticket {
    door: Arc<Door>,
    row_steps: u64,
    _permit: OwnedSemaphorePermit,
}

impl Door {
    pub(super) fn new(sizes: DoorSizes) -> Self {
        let semaphore = |permits: usize| Arc::new(Semaphore::new(permits));
        Self {
            observes: semaphore(sizes.observes),
            rows: semaphore(sizes.rows),
            outputs: semaphore(kib(sizes.output_bytes) as usize),
            ahead: AtomicU64::new(0),
            row_nanos: AtomicU64::new(0),
            observe_nanos: AtomicU64::new(0),
            sizes,
        }
    }

    pub(super) fn admit_observe(self: &Arc<Self>) -> Result<Ticket, Error> {
        let Ok(permit) = Arc::clone(&self.observes).try_acquire_owned() else {
            let ahead = self.sizes.observes as u64 * self.observe_nanos.load(Ordering::Relaxed);
            return Err(overloaded("observations wait", ahead));
        };
        Ok(Ticket { door: Arc::clone(self), row_steps: 0, _permit: permit })
    }

    /// Room for a rollout; the second part is held by whoever fetches its outputs.
    pub(super) fn admit_rollout(
        self: &Arc<Self>,
        (rows, steps): (u32, u32),
        output_bytes: u64,
    ) -> Result<(Ticket, OwnedSemaphorePermit), Error> {
        let refused = |what| {
            let ahead = self.ahead.load(Ordering::Relaxed);
            overloaded(what, ahead.saturating_mul(self.row_nanos.load(Ordering::Relaxed)))
        };
        let Ok(outputs) = Arc::clone(&self.outputs).try_acquire_many_owned(kib(output_bytes))
        else {
            return Err(refused("outputs of rollouts wait to be fetched"));
        };
        let Ok(permit) = Arc::clone(&self.rows).try_acquire_many_owned(rows) else {
            return Err(refused("rows of rollouts wait"));
        };
        let row_steps = u64::from(rows) * u64::from(steps);
        self.ahead.fetch_add(row_steps, Ordering::Relaxed);
        let ticket = Ticket { door: Arc::clone(self), row_steps, _permit: permit };
        Ok((ticket, outputs))
    }

    /// Remembers what row steps or observes cost, smoothed.
    pub(super) fn measured(&self, observe: bool, cost: Duration) {
        let of = if observe { &self.observe_nanos } else { &self.row_nanos };
        let (old, new) = (of.load(Ordering::Relaxed), cost.as_nanos() as u64);
        of.store(if old == 0 { new } else { (old * 7 + new) / 8 }, Ordering::Relaxed);
    }
}

impl Ticket {
    /// Counts row steps as computed.
    pub(super) fn done(&mut self, row_steps: u64) {
        self.row_steps -= row_steps;
        self.door.ahead.fetch_sub(row_steps, Ordering::Relaxed);
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        self.door.ahead.fetch_sub(self.row_steps, Ordering::Relaxed);
    }
}

fn overloaded(what: &'static str, ahead_nanos: u64) -> Error {
    let retry_after = Duration::from_nanos(ahead_nanos).max(Duration::from_millis(1));
    Error::Overloaded { what, retry_after }
}

fn kib(bytes: u64) -> u32 {
    u32::try_from(bytes.div_ceil(1024)).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_let_in_is_bounded_and_given_back() {
        let sizes = DoorSizes { observes: 1, rows: 10, output_bytes: 8 << 10 };
        let door = Arc::new(Door::new(sizes));
        let observe = door.admit_observe().unwrap();
        assert!(matches!(door.admit_observe(), Err(Error::Overloaded { .. })));
        drop(observe);
        door.admit_observe().unwrap();

        door.measured(false, Duration::from_millis(2));
        let (mut ticket, outputs) = door.admit_rollout((8, 5), 8 << 10).unwrap();
        let refused = door.admit_rollout((1, 1), 1).unwrap_err();
        assert_eq!(refused.retry_after(), Some(Duration::from_millis(80)));
        ticket.done(30);
        drop(outputs);
        let refused = door.admit_rollout((8, 1), 1).unwrap_err();
        assert_eq!(refused.retry_after(), Some(Duration::from_millis(20)));
        drop(ticket);
        assert_eq!(door.ahead.load(Ordering::Relaxed), 0);
        drop(door.admit_rollout((8, 1), 8 << 10).unwrap());
    }
}
