//! What a session shows to whoever watches it: its newest step, and nothing while nobody does.
//!
//! A watcher sees the newest step there is when it looks; steps that came while it was busy with an earlier one are
//! passed over, so nobody waits for a slow one, and what is kept for all of them together is one step.

use std::{sync::Arc, time::SystemTime};

use gatsbi_models::scene::Output;
use gatsbi_proto::v1;
use tokio::sync::watch;

use super::session::{Position, Seen};
use crate::engine::commands::{NumberType, Value};

/// The newest step of a session, and from where it was made: enough to make it again.
#[derive(Clone, Debug)]
pub struct Last {
    /// Where the session was before it.
    pub before: Position,
    /// What it saw.
    pub seen: Seen,
}

/// A step as it is shown.
#[derive(Debug)]
pub struct Shown {
    /// Number of the step.
    pub step: u64,
    /// SHA-256 of the checkpoint, hexadecimal.
    pub model_hash: String,
    /// Height and width of the model's images.
    pub image_size: u32,
    /// What was observed.
    pub seen: Seen,
    /// Whether its image was passed over for a newer one.
    pub image_skipped: bool,
    /// Objects of every slot that holds or has held one.
    pub objects: Vec<v1::Object>,
    /// What the model makes of it, as 32-bit floats.
    pub values: Vec<Value>,
    /// Where time went.
    pub timing: v1::Timing,
    /// When it was there.
    pub at: SystemTime,
}

/// Where watchers of one session look.
#[derive(Debug)]
pub struct Live {
    newest: watch::Sender<Option<Arc<Shown>>>,
}

/// One who watches a session.
#[derive(Debug)]
pub struct Watcher {
    newest: watch::Receiver<Option<Arc<Shown>>>,
}

impl Default for Live {
    fn default() -> Self {
        Self { newest: watch::Sender::new(None) }
    }
}

impl Live {
    /// Whether anybody watches.
    pub fn is_watched(&self) -> bool {
        self.newest.receiver_count() > 0
    }

    /// Shows a step.
    pub fn show(&self, shown: Arc<Shown>) {
        let kept = self.is_watched().then_some(shown);
        self.newest.send_replace(kept);
    }

    /// The step that is shown now, if somebody watches.
    pub fn newest(&self) -> Option<Arc<Shown>> {
        let newest = self.newest.borrow();
        newest.as_ref().filter(|_| self.is_watched()).cloned()
    }

    /// Watches from now on.
    pub fn watch(&self) -> Watcher {
        if !self.is_watched() {
            // What the last watcher left behind.
            self.newest.send_replace(None);
        }
        Watcher { newest: self.newest.subscribe() }
    }
}

impl Watcher {
    /// The next step, or the newest one if there were more meanwhile; nothing once the session is closed.
    pub async fn next(&mut self) -> Option<Arc<Shown>> {
        loop {
            self.newest.changed().await.ok()?;
            if let Some(shown) = self.newest.borrow_and_update().clone() {
                return Some(shown);
            }
        }
    }
}

impl Shown {
    /// The numbers of an output; none if the model does not have it.
    pub fn floats(&self, output: Output) -> Option<Vec<f32>> {
        let value = self
            .values
            .iter()
            .find(|value| value.output == output && value.numbers == NumberType::F32)?;
        let (numbers, _) = value.data.as_chunks::<4>();
        Some(numbers.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect())
    }

    /// A single number.
    pub fn number(&self, output: Output) -> Option<f32> {
        self.floats(output)?.first().copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(step: u64) -> Arc<Shown> {
        Arc::new(Shown {
            step,
            model_hash: String::new(),
            image_size: 1,
            seen: Seen { step, frame: None, action: vec![], image: (1, 1) },
            image_skipped: false,
            objects: vec![],
            values: vec![],
            timing: v1::Timing::default(),
            at: SystemTime::now(),
        })
    }

    #[tokio::test]
    async fn a_slow_watcher_sees_the_newest_step_and_nothing_piles_up() {
        let live = Live::default();
        let mut watcher = live.watch();
        let steps: Vec<_> = (0..5).map(shown).collect();
        for step in &steps {
            live.show(Arc::clone(step));
        }
        assert_eq!(watcher.next().await.unwrap().step, 4);
        let kept: Vec<usize> = steps.iter().map(Arc::strong_count).collect();
        assert_eq!(kept, [1, 1, 1, 1, 2]);
        drop(live);
        assert!(watcher.next().await.is_none(), "the session is closed");
    }

    #[test]
    fn nothing_is_kept_for_nobody() {
        let live = Live::default();
        let first = shown(0);
        live.show(Arc::clone(&first));
        assert_eq!((live.is_watched(), Arc::strong_count(&first)), (false, 1));
        let watcher = live.watch();
        live.show(Arc::clone(&first));
        assert_eq!(live.newest().unwrap().step, 0);
        drop(watcher);
        assert!(live.newest().is_none());
        live.show(shown(1));
        assert_eq!(Arc::strong_count(&first), 1);
    }
}
