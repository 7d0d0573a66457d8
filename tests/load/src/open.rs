//! An open load: frames come at a constant rate, and time is counted from when they came.
//!
//! A robot's frames are dealt with in order, so one that comes while an earlier one is under way waits, and its time
//! holds the waiting. What the service has not dealt with some time after the last frame came is given up and counted.

use std::time::Duration;

use anyhow::Result;
use tokio::time::{Instant, sleep_until};

use crate::record::Outcome;

/// When frames come.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Arrivals {
    /// The first.
    pub(crate) first: Instant,
    /// From one to the next.
    pub(crate) period: Duration,
    /// After this there are no more.
    pub(crate) end: Instant,
    /// How long after the end those that wait are still dealt with.
    pub(crate) grace: Duration,
}

/// What became of one frame.
pub(crate) enum Dealt {
    /// The moments at which its belief and everything were there.
    Done { observed: Instant, done: Instant },
    /// The service refused it, which an overloaded one should.
    Refused,
}

impl Arrivals {
    /// When frame `number` comes, if it comes.
    fn due(&self, number: u32) -> Option<Instant> {
        Some(self.first + self.period * number).filter(|due| *due < self.end)
    }

    /// Has every frame dealt with by `deal`.
    ///
    /// # Errors
    /// The first failure that is no refusal.
    pub(crate) async fn serve(
        self,
        mut deal: impl AsyncFnMut() -> Result<Dealt>,
    ) -> Result<Outcome> {
        let mut outcome = Outcome::default();
        for number in 0.. {
            let Some(due) = self.due(number) else { break };
            sleep_until(due).await;
            if Instant::now() > self.end + self.grace {
                outcome.unserved += 1;
                outcome.observed.record(due.elapsed());
                outcome.done.record(due.elapsed());
                continue;
            }
            match deal().await? {
                Dealt::Done { observed, done } => {
                    outcome.observed.record(observed - due);
                    outcome.done.record(done - due);
                }
                Dealt::Refused => outcome.refused += 1,
            }
        }
        Ok(outcome)
    }
}

#[cfg(test)]
mod tests {
    use tokio::time::sleep;

    use super::*;

    const fn millis(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    fn arrivals(seconds: u64) -> Arrivals {
        let first = Instant::now();
        let end = first + Duration::from_secs(seconds);
        Arrivals { first, period: millis(10), end, grace: millis(500) }
    }

    async fn took(time: Duration) -> Result<Dealt> {
        sleep(time).await;
        let now = Instant::now();
        Ok(Dealt::Done { observed: now, done: now })
    }

    #[tokio::test(start_paused = true)]
    async fn a_stall_counts_for_every_frame_that_came_meanwhile() {
        let mut number = 0;
        let outcome = arrivals(1)
            .serve(async || {
                number += 1;
                // One frame of a hundred takes a quarter of a second, the others a millisecond.
                took(millis(if number == 20 { 250 } else { 1 })).await
            })
            .await
            .unwrap();
        assert_eq!((outcome.done.count(), outcome.unserved), (100, 0));
        // A generator that waits for its answers would have seen one slow frame; 25 came during the stall.
        assert!(outcome.done.percentile(70.0) < millis(20), "{:?}", outcome.done);
        assert!(outcome.done.percentile(90.0) > millis(100), "{:?}", outcome.done);
    }

    #[tokio::test(start_paused = true)]
    async fn what_is_never_dealt_with_counts_too() {
        let outcome = arrivals(1).serve(async || took(millis(30)).await).await.unwrap();
        assert_eq!(outcome.done.count(), 100);
        assert!(outcome.unserved > 40, "{}", outcome.unserved);
        assert!(outcome.done.percentile(99.0) > millis(500));
    }
}
