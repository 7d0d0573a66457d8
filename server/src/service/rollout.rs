//! A rollout on its way: its chunks as messages, in the order in which they come.

use std::{collections::VecDeque, time::Instant};

use gatsbi_proto::v1;

use super::{answer, aside, fields::Selection, spread::Spread};
use crate::{
    engine::{Chunks, commands::Chunk},
    error::Error,
    telemetry,
};

/// A rollout on its way. Dropped, it ends, and its rows make room for others.
#[derive(Debug)]
pub struct Rollout {
    chunks: Chunks,
    /// What all chunks share.
    common: v1::RolloutChunk,
    selection: Selection,
    spread: Spread,
    deadline: Option<Instant>,
    ready: VecDeque<v1::RolloutChunk>,
    ended: bool,
}

impl Rollout {
    pub(super) fn new(
        chunks: Chunks,
        common: v1::RolloutChunk,
        selection: Selection,
        samples: u32,
        deadline: Option<Instant>,
    ) -> Self {
        let (spread, ready) = (Spread::new(samples), VecDeque::new());
        Self { chunks, common, selection, spread, deadline, ready, ended: false }
    }

    /// The next chunk; nothing after the last one or an error.
    pub async fn next(&mut self) -> Option<Result<v1::RolloutChunk, Error>> {
        loop {
            if let Some(chunk) = self.ready.pop_front() {
                return Some(Ok(chunk));
            }
            if self.ended {
                return None;
            }
            if let Err(error) = self.receive().await {
                self.ended = true;
                return Some(Err(error));
            }
        }
    }

    /// Waits for a chunk of the engine and makes messages of it, if it gives any.
    async fn receive(&mut self) -> Result<(), Error> {
        // A rollout ends with its last chunk or a failure; only the end of the engine cuts it short.
        let chunk = self.chunks.next().await.unwrap_or(Err(Error::ShuttingDown))?;
        if self.deadline.is_some_and(|at| at <= Instant::now()) {
            return Err(Error::DeadlineExceeded);
        }
        telemetry::waited(telemetry::Kind::Imagine, chunk.spent.queue);
        self.ended = chunk.last;
        let over_samples = self.spread.add(&chunk);
        if !chunk.values.is_empty() {
            let chunk = self.message(chunk).await?;
            self.ready.push_back(chunk);
        }
        for (candidate, depth, outputs) in over_samples {
            self.ready.push_back(v1::RolloutChunk {
                first_candidate: candidate,
                candidates: 1,
                depths: vec![depth],
                outputs,
                over_samples: true,
                timing: Some(v1::Timing::default()),
                ..self.common.clone()
            });
        }
        if let (true, Some(last)) = (self.ended, self.ready.back_mut()) {
            last.last = true;
        }
        Ok(())
    }

    async fn message(&self, chunk: Chunk) -> Result<v1::RolloutChunk, Error> {
        let began = Instant::now();
        let (values, leading, png) = (chunk.values, [chunk.candidates, 1], self.selection.png);
        let encode = move || answer::outputs(values, &leading, png);
        let outputs = if png { aside(encode).await? } else { encode() };
        Ok(v1::RolloutChunk {
            sample: chunk.sample,
            first_candidate: chunk.first_candidate,
            candidates: chunk.candidates,
            depths: vec![chunk.depth],
            outputs,
            timing: Some(answer::timing(chunk.spent, began.elapsed())),
            ..self.common.clone()
        })
    }
}
