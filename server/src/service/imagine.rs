//! Imagining: rollouts from a session's belief, chunk by chunk.

use std::time::Instant;

use gatsbi_models::{
    scene::{Output, Outputs},
    world_model::ModelSpec,
};
use gatsbi_proto::v1;

use super::{
    Service, answer, aside,
    fields::{self, Steps},
};
use crate::{
    engine::{
        Chunks,
        commands::{Chunk, Form, Imagine},
    },
    error::Error,
    telemetry, tensor,
};

/// A rollout on its way. Dropped, it ends, and its rows make room for others.
#[derive(Debug)]
pub struct Rollout {
    chunks: Chunks,
    /// What all chunks share.
    common: v1::RolloutChunk,
    png: bool,
    deadline: Option<Instant>,
    ended: bool,
}

/// How a rollout draws.
struct Draws {
    seed: Option<u64>,
    samples: u32,
    independent: bool,
}

impl Service {
    /// Starts a rollout; `deadline` is the call's own.
    ///
    /// # Errors
    /// If the request is wrong, the session has moved, or there is too much to do already.
    pub async fn imagine(
        &self,
        request: v1::ImagineRequest,
        deadline: Option<Instant>,
    ) -> Result<Rollout, Error> {
        let session = self.session(&request.session_id)?;
        let model = self.engine.model(session.opened.model);
        let deadline = fields::deadline(request.timeout_millis, deadline)?;
        if request.costs.is_some() {
            return Err(Error::Unimplemented { what: "costs of rollouts" });
        }
        let (actions, candidates, horizon) = self.actions(request.actions, &model.spec)?;
        let draws = self.draws(request.sampling.unwrap_or_default())?;
        let rows = u64::from(candidates) * u64::from(draws.samples);
        if rows > self.limits.max_rows.into() {
            let found = format!("{candidates} candidates x {} samples", draws.samples);
            let expected = format!("at most {} rows", self.limits.max_rows);
            return Err(Error::invalid("actions", found, expected));
        }
        let outputs = request.outputs.unwrap_or_default();
        let selection = fields::selection(&outputs, Steps::Imagined { horizon }, &model.spec)?;

        // What is pinned here stays as it is, whatever the session observes meanwhile.
        let position = session.position();
        let Some(last) = position.next_step.checked_sub(1) else {
            return Err(Error::NothingObserved);
        };
        if let Some(at_step) = request.at_step.filter(|at_step| *at_step != last) {
            return Err(Error::SessionMoved { at_step, last });
        }
        let job = Imagine {
            model: model.id,
            start: position.state,
            step: position.next_step,
            actions: actions.into(),
            candidates,
            horizon,
            samples: draws.samples,
            seed: draws.seed,
            independent: draws.independent,
            wanted: selection.wanted,
            depths: selection.depths,
            deadline,
        };
        let bytes = self.output_bytes(&job, &model.spec)?;
        let common = v1::RolloutChunk {
            at_step: last,
            model_hash: model.spec.hash.clone(),
            seed: draws.seed.unwrap_or(0),
            ..v1::RolloutChunk::default()
        };
        tracing::debug!(session = %session.id, rows, horizon, output_bytes = bytes, "imagining");
        let chunks = self.engine.imagine(job, bytes).await?;
        Ok(Rollout { chunks, common, png: selection.png, deadline, ended: false })
    }

    fn actions(
        &self,
        actions: Option<v1::Tensor>,
        spec: &ModelSpec,
    ) -> Result<(Vec<f32>, u32, u32), Error> {
        let width = spec.actions.len() as u32;
        let shape = || format!("[candidates, horizon, {width}] or [horizon, {width}]");
        let Some(actions) = actions else {
            return Err(Error::invalid("actions", "absent", shape()));
        };
        let (candidates, horizon) = match *actions.shape.as_slice() {
            [candidates, horizon, found] if found == width => (candidates, horizon),
            [horizon, found] if found == width => (1, horizon),
            _ => {
                let found = format!("{:?}", actions.shape);
                return Err(Error::invalid("actions.shape", found, shape()));
            }
        };
        let v1::Limits { max_candidates, max_horizon, .. } = self.limits;
        let count = |what: &str, found: u32, most: u32| {
            let expected = format!("1 to {most} {what}");
            fields::unless((1..=most).contains(&found), "actions.shape", found, expected)
        };
        fields::all(vec![
            count("candidates", candidates, max_candidates),
            count("steps of horizon", horizon, max_horizon),
        ])?;
        Ok((tensor::floats(&actions, "actions")?, candidates, horizon))
    }

    fn draws(&self, sampling: v1::Sampling) -> Result<Draws, Error> {
        let samples = sampling.samples.unwrap_or(1);
        let most = self.limits.max_samples;
        if !(1..=most).contains(&samples) {
            return Err(Error::invalid("sampling.samples", samples, format!("1 to {most}")));
        }
        let independent = sampling.independent_candidates;
        if fields::samples(sampling.mode, "sampling.mode")? {
            let seed = Some(sampling.seed.unwrap_or_else(fields::random_seed));
            return Ok(Draws { seed, samples, independent });
        }
        if samples != 1 {
            let expected = "1: with MODE_MEAN all samples would be the same";
            return Err(Error::invalid("sampling.samples", samples, expected));
        }
        match sampling.seed {
            Some(seed) => {
                let expected = "absent: MODE_MEAN draws no random numbers";
                Err(Error::invalid("sampling.seed", seed, expected))
            }
            None => Ok(Draws { seed: None, samples, independent }),
        }
    }

    /// Bytes of all outputs of a rollout before they are made PNG.
    fn output_bytes(&self, job: &Imagine, spec: &ModelSpec) -> Result<u64, Error> {
        let steps = (1..=job.horizon).filter(|depth| job.wants(*depth)).count() as u64;
        let row = row_bytes(job.wanted.outputs, job.wanted.form, spec);
        let bytes = u64::from(job.rows()) * steps * row;
        let most = self.limits.max_output_bytes;
        if bytes > most {
            let found = format!("{bytes} bytes over {} rows and {steps} steps", job.rows());
            let expected =
                format!("at most {most} bytes: fewer outputs, every_k, last_only, or U8");
            return Err(Error::invalid("outputs", found, expected));
        }
        Ok(bytes)
    }
}

impl Rollout {
    /// The next chunk; nothing after the last one or an error.
    pub async fn next(&mut self) -> Option<Result<v1::ImagineResponse, Error>> {
        if self.ended {
            return None;
        }
        let chunk = match self.chunks.next().await {
            Some(Ok(_)) if self.deadline.is_some_and(|at| at <= Instant::now()) => {
                Err(Error::DeadlineExceeded)
            }
            Some(Ok(chunk)) => self.chunk(chunk).await,
            Some(Err(error)) => Err(error),
            // A rollout ends with its last chunk or a failure; only the end of the engine cuts it short.
            None => Err(Error::ShuttingDown),
        };
        self.ended = chunk.as_ref().map_or(true, |chunk| chunk.last);
        Some(chunk.map(|chunk| v1::ImagineResponse { chunk: Some(chunk) }))
    }

    async fn chunk(&self, chunk: Chunk) -> Result<v1::RolloutChunk, Error> {
        telemetry::waited(telemetry::Kind::Imagine, chunk.spent.queue);
        let began = Instant::now();
        let (values, leading, png) = (chunk.values, [chunk.candidates, 1], self.png);
        let encode = move || answer::outputs(values, &leading, png);
        let outputs = if png { aside(encode).await? } else { encode() };
        Ok(v1::RolloutChunk {
            sample: chunk.sample,
            first_candidate: chunk.first_candidate,
            candidates: chunk.candidates,
            depths: vec![chunk.depth],
            outputs,
            last: chunk.last,
            timing: Some(answer::timing(chunk.spent, began.elapsed())),
            ..self.common.clone()
        })
    }
}

/// Bytes of the outputs of one row at one step.
fn row_bytes(outputs: Outputs, form: Form, spec: &ModelSpec) -> u64 {
    let number = if form == Form::F16 { 2 } else { 4 };
    let picture = if form == Form::U8 { 1 } else { number };
    let pixels = (spec.image_size * spec.image_size) as u64;
    let bytes = |output: Output| match output {
        Output::Frame | Output::Background => 3 * pixels * picture,
        Output::AgentMask => pixels * picture,
        Output::SlotMasks => spec.slots as u64 * pixels * picture,
        Output::ObjectMasks => spec.max_objects as u64 * pixels * picture,
        Output::Objects => spec.max_objects as u64 * (6 * 4 + 8),
        Output::Latents => spec.latents as u64 * number,
        Output::Keypoints => spec.keypoints.unwrap_or(0) as u64 * 3 * number,
        Output::Surprise | Output::LogLikelihood => 4,
    };
    outputs.iter().map(bytes).sum()
}
