//! What the engine has done since it started, and what waits: counters that anybody may read at any time.
//!
//! Rates are for whoever looks twice: everything here only grows, but for [`Waiting`].

use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use crate::telemetry::Kind;

/// Counters, written by the model's thread and the door.
#[derive(Debug, Default)]
pub(super) struct Gauges {
    ticks: AtomicU64,
    refused: AtomicU64,
    kinds: [Counted; 2],
}

#[derive(Debug, Default)]
struct Counted {
    blocks: AtomicU64,
    rows: AtomicU64,
    lanes: AtomicU64,
    nanos: AtomicU64,
}

/// The counters at one moment.
#[derive(Clone, Copy, Debug)]
pub struct Reading {
    /// Rounds of the model's thread.
    pub ticks: u64,
    /// Requests that were not let in.
    pub refused: u64,
    /// Steps with an observation.
    pub observe: Computed,
    /// Steps of rollouts.
    pub imagine: Computed,
    /// What is let in and not answered.
    pub waiting: Waiting,
}

/// What went through the model.
#[derive(Clone, Copy, Debug)]
pub struct Computed {
    /// Blocks.
    pub blocks: u64,
    /// Rows in them.
    pub rows: u64,
    /// Rows that there was room for.
    pub lanes: u64,
    /// Time that they took together.
    pub time: Duration,
}

/// What is let in and not answered, live and bulk work together.
#[derive(Clone, Copy, Debug)]
pub struct Waiting {
    /// Observations.
    pub observes: u64,
    /// Rows of rollouts.
    pub rows: u64,
    /// Predicted time of all of it.
    pub time: Duration,
}

impl Gauges {
    /// A round has begun.
    pub(super) fn tick(&self) {
        self.ticks.fetch_add(1, Ordering::Relaxed);
    }

    /// A request was not let in.
    pub(super) fn refused(&self) {
        self.refused.fetch_add(1, Ordering::Relaxed);
    }

    /// A block went through the model.
    pub(super) fn block(&self, kind: Kind, rows: usize, lanes: usize, elapsed: Duration) {
        let counted = &self.kinds[kind as usize];
        counted.blocks.fetch_add(1, Ordering::Relaxed);
        counted.rows.fetch_add(rows as u64, Ordering::Relaxed);
        counted.lanes.fetch_add(lanes as u64, Ordering::Relaxed);
        counted.nanos.fetch_add(elapsed.as_nanos() as u64, Ordering::Relaxed);
    }

    /// The counters now, beside what waits.
    pub(super) fn read(&self, waiting: Waiting) -> Reading {
        let of = |kind: Kind| {
            let Counted { blocks, rows, lanes, nanos } = &self.kinds[kind as usize];
            let [blocks, rows, lanes, nanos] =
                [blocks, rows, lanes, nanos].map(|counter| counter.load(Ordering::Relaxed));
            Computed { blocks, rows, lanes, time: Duration::from_nanos(nanos) }
        };
        Reading {
            ticks: self.ticks.load(Ordering::Relaxed),
            refused: self.refused.load(Ordering::Relaxed),
            observe: of(Kind::Observe),
            imagine: of(Kind::Imagine),
            waiting,
        }
    }
}
