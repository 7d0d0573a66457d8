//! What is counted: times in a histogram, and what was not answered.

use std::time::Duration;

use anyhow::Result;
use hdrhistogram::Histogram;

/// Times between a microsecond and an hour, to three digits.
#[derive(Debug)]
pub(crate) struct Times(Histogram<u64>);

impl Default for Times {
    fn default() -> Self {
        Self(Histogram::new_with_bounds(1, 3_600_000_000, 3).expect("the bounds are in order"))
    }
}

impl Times {
    pub(crate) fn record(&mut self, time: Duration) {
        self.0.saturating_record((time.as_micros() as u64).max(1));
    }

    pub(crate) fn add(&mut self, other: &Self) -> Result<()> {
        Ok(self.0.add(&other.0)?)
    }

    pub(crate) fn count(&self) -> u64 {
        self.0.len()
    }

    /// The time within which so many of a hundred were.
    pub(crate) fn percentile(&self, percent: f64) -> Duration {
        Duration::from_micros(self.0.value_at_percentile(percent))
    }

    /// The same in milliseconds.
    pub(crate) fn millis(&self, percent: f64) -> f64 {
        1e3 * self.percentile(percent).as_secs_f64()
    }
}

/// What became of frames under an open load. Times are from when a frame came.
#[derive(Debug, Default)]
pub(crate) struct Outcome {
    /// Until its belief was there.
    pub(crate) observed: Times,
    /// Until all that it asks for was there: the belief, and the futures that were imagined from it.
    pub(crate) done: Times,
    /// Frames that were refused, in part or whole.
    pub(crate) refused: u64,
    /// Frames that the load ended before: they count with the time that they have waited.
    pub(crate) unserved: u64,
}

impl Outcome {
    pub(crate) fn add(&mut self, other: &Self) -> Result<()> {
        self.observed.add(&other.observed)?;
        self.done.add(&other.done)?;
        self.refused += other.refused;
        self.unserved += other.unserved;
        Ok(())
    }

    pub(crate) fn frames(&self) -> u64 {
        self.done.count() + self.refused
    }

    /// Whether 99 of 100 frames were done within a time.
    pub(crate) fn keeps(&self, period: Duration) -> bool {
        self.refused * 100 <= self.frames() && self.done.percentile(99.0) <= period
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_refused_is_not_kept() {
        let (period, mut outcome) = (Duration::from_millis(100), Outcome::default());
        for _ in 0..100 {
            outcome.done.record(Duration::from_millis(60));
        }
        assert!(outcome.keeps(period) && !outcome.keeps(period / 2));
        outcome.refused = 1;
        assert!(outcome.keeps(period));
        outcome.refused = 2;
        assert!(!outcome.keeps(period));
    }
}
