//! What will happen if: chunks of a rollout as the steps finish, or the whole of it.

use std::time::Duration;

use gatsbi_proto::v1;
use tokio::time::timeout;
use tonic::Streaming;

use crate::{
    Output, Timing,
    error::{Error, Result},
    output::{Outputs, Value},
};

/// A part of a rollout that describes itself. Chunks come in no particular order, but a candidate's depths ascend.
#[derive(Clone, Debug, PartialEq)]
pub struct RolloutChunk {
    /// Last observed step of the belief that the rollout starts from.
    pub at_step: u64,
    /// SHA-256 of the checkpoint, hexadecimal.
    pub model_hash: String,
    /// Seed that was used; 0 where means were taken.
    pub seed: u64,
    /// Sample, from 0.
    pub sample: usize,
    /// First candidate of the chunk, from 0.
    pub first_candidate: usize,
    /// How many candidates: the first axis of the outputs.
    pub candidates: usize,
    /// Imagined depths, from 1: the second axis of the outputs.
    pub depths: Vec<u32>,
    /// The outputs that were asked for, `[candidates, depths, ...]`.
    pub outputs: Outputs,
    /// Whether this is the last chunk.
    pub last: bool,
    /// Where the time went.
    pub timing: Timing,
}

/// A rollout that is on its way. Dropped, it is cancelled.
#[derive(Debug)]
pub struct RolloutStream {
    chunks: Streaming<v1::ImagineResponse>,
    first: Option<v1::ImagineResponse>,
    patience: Duration,
    candidates: usize,
    samples: usize,
    depths: Vec<u32>,
    ended: bool,
}

/// A whole rollout.
#[derive(Clone, Debug, PartialEq)]
pub struct Rollout {
    /// Last observed step of the belief that it starts from.
    pub at_step: u64,
    /// SHA-256 of the checkpoint, hexadecimal.
    pub model_hash: String,
    /// Seed that was used; 0 where means were taken.
    pub seed: u64,
    /// Samples S.
    pub samples: usize,
    /// Candidates N.
    pub candidates: usize,
    /// Imagined depths D, from 1.
    pub depths: Vec<u32>,
    /// The outputs that were asked for, `[S, N, D, ...]`; of spreads, which are over the samples, `[1, N, D, ...]`.
    pub outputs: Outputs,
}

impl RolloutStream {
    pub(crate) fn new(
        chunks: Streaming<v1::ImagineResponse>,
        first: Option<v1::ImagineResponse>,
        patience: Duration,
        [candidates, samples]: [usize; 2],
        depths: Vec<u32>,
    ) -> Self {
        Self { chunks, first, patience, candidates, samples, depths, ended: false }
    }

    /// The next chunk; nothing after the last.
    ///
    /// # Errors
    /// What the server says, a connection that breaks, or a chunk that does not come in time. The rollout is then over.
    pub async fn next(&mut self) -> Option<Result<RolloutChunk>> {
        if self.ended {
            return None;
        }
        let chunk = self.receive().await;
        self.ended = chunk.as_ref().map_or(true, |chunk| chunk.last);
        Some(chunk)
    }

    /// Waits for all chunks and puts them together.
    ///
    /// # Errors
    /// As [`RolloutStream::next`]; [`Error::Answer`] if a part is missing.
    pub async fn gather(mut self) -> Result<Rollout> {
        let mut gathered = Gathered::new([self.samples, self.candidates], self.depths.clone());
        while let Some(chunk) = self.next().await {
            gathered.put(chunk?)?;
        }
        gathered.finish()
    }

    async fn receive(&mut self) -> Result<RolloutChunk> {
        let response = match self.first.take() {
            Some(response) => Some(response),
            None => match timeout(self.patience, self.chunks.message()).await {
                Ok(message) => message?,
                Err(_) => return Err(Error::TimedOut(self.patience)),
            },
        };
        let chunk =
            response.ok_or_else(|| Error::Answer("a rollout without its end".into()))?.chunk;
        chunk.ok_or_else(|| Error::Answer("a chunk is missing".into()))?.try_into()
    }
}

impl TryFrom<v1::RolloutChunk> for RolloutChunk {
    type Error = Error;

    fn try_from(chunk: v1::RolloutChunk) -> Result<Self> {
        Ok(Self {
            at_step: chunk.at_step,
            model_hash: chunk.model_hash,
            seed: chunk.seed,
            sample: chunk.sample as usize,
            first_candidate: chunk.first_candidate as usize,
            candidates: chunk.candidates as usize,
            depths: chunk.depths,
            outputs: chunk.outputs.try_into()?,
            last: chunk.last,
            timing: chunk.timing.unwrap_or_default(),
        })
    }
}

/// Parts of a rollout, each in its place.
struct Gathered {
    samples: usize,
    candidates: usize,
    depths: Vec<u32>,
    /// By output the values of `[S, N, D]`, as far as they are there.
    parts: Vec<(Output, Vec<Option<Value>>)>,
    last: Option<RolloutChunk>,
}

impl Gathered {
    fn new([samples, candidates]: [usize; 2], depths: Vec<u32>) -> Self {
        Self { samples, candidates, depths, parts: Vec::new(), last: None }
    }

    fn put(&mut self, chunk: RolloutChunk) -> Result<()> {
        let places: Option<Vec<usize>> = chunk
            .depths
            .iter()
            .map(|depth| self.depths.iter().position(|wanted| wanted == depth))
            .collect();
        let end = chunk.first_candidate + chunk.candidates;
        let Some(places) = places.filter(|_| end <= self.candidates && chunk.sample < self.samples)
        else {
            return Err(Error::Answer("a chunk that was not asked for".into()));
        };
        for (output, value) in chunk.outputs.iter() {
            if value.leading() != Some([chunk.candidates, places.len()]) {
                let output = output.as_str_name();
                return Err(Error::Answer(format!("a chunk of another size in {output}")));
            }
            // A spread is over the samples, and comes with the last.
            let (sample, samples) =
                if is_spread(output) { (0, 1) } else { (chunk.sample, self.samples) };
            let all = samples * self.candidates * self.depths.len();
            if self.parts.iter().all(|(which, _)| *which != output) {
                self.parts.push((output, vec![None; all]));
            }
            let parts = self.parts.iter_mut().filter(|(which, _)| *which == output);
            for (_, parts) in parts {
                for candidate in 0..chunk.candidates {
                    let row = sample * self.candidates + chunk.first_candidate + candidate;
                    for (depth, place) in places.iter().enumerate() {
                        let part = value.at(&[candidate, depth]);
                        parts[row * self.depths.len() + place] = Some(part);
                    }
                }
            }
        }
        self.last = Some(chunk);
        Ok(())
    }

    fn finish(self) -> Result<Rollout> {
        let mut outputs = Outputs::default();
        for (output, parts) in self.parts {
            let samples = if is_spread(output) { 1 } else { self.samples };
            let leading = [samples, self.candidates, self.depths.len()];
            let parts: Option<Vec<_>> = parts.into_iter().collect();
            let whole = parts.and_then(|parts| Value::stack(&leading, &parts));
            let output_name = output.as_str_name();
            let missing = || Error::Answer(format!("a rollout with gaps in {output_name}"));
            outputs.push(output, whole.ok_or_else(missing)?);
        }
        let last = self.last.ok_or_else(|| Error::Answer("a rollout without chunks".into()))?;
        Ok(Rollout {
            at_step: last.at_step,
            model_hash: last.model_hash,
            seed: last.seed,
            samples: self.samples,
            candidates: self.candidates,
            depths: self.depths,
            outputs,
        })
    }
}

fn is_spread(output: Output) -> bool {
    matches!(output, Output::Spread | Output::ObjectSpread)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::{Array, Numbers};

    /// A chunk whose number is `100 sample + 10 candidate + depth`.
    fn chunk(sample: usize, candidates: std::ops::Range<usize>, depths: &[u32]) -> RolloutChunk {
        let mut numbers = Vec::new();
        for candidate in candidates.clone() {
            numbers.extend(
                depths.iter().map(|d| (100 * sample + 10 * candidate) as i64 + i64::from(*d)),
            );
        }
        let shape = vec![candidates.len(), depths.len()];
        let array = Array::new(shape, Numbers::I64(numbers)).unwrap();
        let mut outputs = Outputs::default();
        outputs.push(Output::Costs, Value::Array(array.clone()));
        if sample == 1 {
            outputs.push(Output::Spread, Value::Array(array));
        }
        RolloutChunk {
            at_step: 4,
            model_hash: String::new(),
            seed: 7,
            sample,
            first_candidate: candidates.start,
            candidates: candidates.len(),
            depths: depths.to_vec(),
            outputs,
            last: false,
            timing: Timing::default(),
        }
    }

    fn gather(chunks: Vec<RolloutChunk>) -> Result<Rollout> {
        let mut gathered = Gathered::new([2, 3], vec![2, 4]);
        for chunk in chunks {
            gathered.put(chunk)?;
        }
        gathered.finish()
    }

    #[test]
    fn chunks_find_their_places_in_any_order() {
        let rollout = gather(vec![
            chunk(1, 2..3, &[2, 4]),
            chunk(0, 0..3, &[2]),
            chunk(1, 0..2, &[2]),
            chunk(0, 0..3, &[4]),
            chunk(1, 0..2, &[4]),
        ])
        .unwrap();
        let costs = rollout.outputs.array(Output::Costs).unwrap();
        assert_eq!(costs.shape(), [2, 3, 2]);
        let expected = [2, 4, 12, 14, 22, 24, 102, 104, 112, 114, 122, 124];
        assert_eq!(costs.numbers(), &Numbers::I64(expected.to_vec()));
        let spread = rollout.outputs.array(Output::Spread).unwrap();
        assert_eq!(spread.shape(), [1, 3, 2]);
        assert_eq!(spread.numbers(), &Numbers::I64(expected[6..].to_vec()));
        assert_eq!((rollout.at_step, rollout.seed), (4, 7));
    }

    #[test]
    fn gaps_and_strangers_are_refused() {
        #[track_caller]
        fn check(chunks: Vec<RolloutChunk>, what: &str) {
            let error = gather(chunks).unwrap_err().to_string();
            assert!(error.ends_with(what), "{error}");
        }
        check(vec![], "a rollout without chunks");
        check(vec![chunk(0, 0..3, &[2, 4])], "a rollout with gaps in OUTPUT_COSTS");
        check(vec![chunk(0, 2..4, &[2])], "a chunk that was not asked for");
        check(vec![chunk(2, 0..1, &[2])], "a chunk that was not asked for");
        check(vec![chunk(0, 0..1, &[3])], "a chunk that was not asked for");
        let mut odd = chunk(0, 0..2, &[2]);
        odd.candidates = 3;
        check(vec![odd], "a chunk of another size in OUTPUT_COSTS");
    }
}
