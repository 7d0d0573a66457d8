//! Imagining: what a rollout is to be, and where its rows begin.

use std::{sync::Arc, time::Instant};

use gatsbi_models::{
    noise::RowNoise,
    scene::{Output, Outputs},
    world_model::ModelSpec,
};
use gatsbi_proto::v1;

use super::{
    Call, Service,
    fields::{self, Selection, Steps},
    rollout::Rollout,
    spread::spread_bytes,
};
use crate::{
    engine::commands::{Depths, Form, Imagine, RowStart, Tenant, Urgency},
    error::Error,
    sessions::session::Position,
    tensor,
};

/// What a request asks of a rollout, wherever it starts.
pub(super) struct Asked {
    pub(super) actions: Option<v1::Tensor>,
    pub(super) sampling: Option<v1::Sampling>,
    pub(super) outputs: Option<v1::OutputSelection>,
    pub(super) costs: Option<v1::CostProgram>,
}

/// A rollout that was asked for as it should be.
#[derive(Debug)]
pub(super) struct Plan {
    actions: Arc<[f32]>,
    candidates: u32,
    horizon: u32,
    draws: Draws,
    selection: Selection,
    pub(super) output_bytes: u64,
}

impl Plan {
    pub(super) fn rows(&self) -> u32 {
        self.candidates * self.draws.samples
    }
}

/// How a rollout draws.
#[derive(Clone, Copy, Debug)]
pub(super) struct Draws {
    pub(super) seed: Option<u64>,
    pub(super) samples: u32,
    independent: bool,
}

impl Draws {
    /// Where a row begins that is a sample of a candidate.
    pub(super) fn start(
        self,
        position: &Position,
        row: u32,
        (candidate, sample): (u32, u32),
    ) -> RowStart {
        // Limits keep both below 2^16, so no two of them meet.
        let apart = if self.independent { candidate << 16 } else { 0 };
        let (sample, step) = (sample | apart, position.next_step);
        let noise =
            self.seed.map_or(RowNoise::Mean, |seed| RowNoise::Sample { seed, sample, step });
        let lane = self.seed.unwrap_or(0).wrapping_add(row.into());
        RowStart { state: Arc::clone(&position.state), noise, lane }
    }

    /// Where the rows of a rollout begin, all of them at one belief.
    pub(super) fn starts(self, position: &Position, candidates: u32) -> Vec<RowStart> {
        let rows = 0..candidates * self.samples;
        rows.map(|row| self.start(position, row, (row % candidates, row / candidates))).collect()
    }
}

impl Service {
    /// Starts a rollout.
    ///
    /// # Errors
    /// If the request is wrong, the session has moved, or there is too much to do already.
    pub async fn imagine(&self, request: v1::ImagineRequest, call: Call) -> Result<Rollout, Error> {
        let session = self.session(&request.session_id)?;
        // What is pinned here stays as it is, whatever the session observes meanwhile.
        let position = session.position();
        let model = Arc::clone(&position.model);
        let deadline = fields::deadline(request.timeout_millis, call.deadline)?;
        let asked = Asked {
            actions: request.actions,
            sampling: request.sampling,
            outputs: request.outputs,
            costs: request.costs,
        };
        let plan = self.plan(asked, &model.spec)?;
        let last = position.last(request.at_step)?;
        let tenant = call.tenant.unwrap_or(Tenant(session.id.bits()));
        tracing::debug!(session = %session.id, last, ?plan, "imagining");
        self.roll_out(plan, &position, (tenant, Urgency::Live), deadline).await
    }

    /// What a rollout on some model is to be.
    ///
    /// # Errors
    /// If the request is wrong.
    pub(super) fn plan(&self, asked: Asked, spec: &ModelSpec) -> Result<Plan, Error> {
        if asked.costs.is_some() {
            return Err(Error::Unimplemented { what: "costs of rollouts" });
        }
        let (actions, candidates, horizon) = self.actions(asked.actions, spec)?;
        let draws = self.draws(asked.sampling.unwrap_or_default())?;
        let rows = u64::from(candidates) * u64::from(draws.samples);
        if rows > self.limits.max_rows.into() {
            let found = format!("{candidates} candidates x {} samples", draws.samples);
            let expected = format!("at most {} rows", self.limits.max_rows);
            return Err(Error::invalid("actions", found, expected));
        }
        let steps = Steps::Imagined { horizon, samples: draws.samples };
        let selection = fields::selection(&asked.outputs.unwrap_or_default(), steps, spec)?;
        let output_bytes =
            self.output_bytes((candidates, draws.samples, horizon), selection, spec)?;
        let actions = actions.into();
        Ok(Plan { actions, candidates, horizon, draws, selection, output_bytes })
    }

    /// Starts a rollout from where some session is, or would be.
    ///
    /// # Errors
    /// If there is too much to do already.
    pub(super) async fn roll_out(
        &self,
        plan: Plan,
        position: &Position,
        (tenant, urgency): (Tenant, Urgency),
        deadline: Option<Instant>,
    ) -> Result<Rollout, Error> {
        let Plan { actions, candidates, horizon, draws, selection, output_bytes } = plan;
        let common = v1::RolloutChunk {
            at_step: position.last(None)?,
            model_hash: position.model.spec.hash.clone(),
            seed: draws.seed.unwrap_or(0),
            ..v1::RolloutChunk::default()
        };
        let job = Imagine {
            model: Arc::clone(&position.model),
            tenant,
            starts: draws.starts(position, candidates),
            actions,
            candidates,
            horizon,
            wanted: selection.wanted,
            depths: selection.depths,
            states: false,
            deadline,
            urgency,
        };
        let chunks = self.roll(job, output_bytes).await?;
        Ok(Rollout::new(chunks, common, selection, draws.samples, deadline))
    }

    pub(super) fn actions(
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

    pub(super) fn draws(&self, sampling: v1::Sampling) -> Result<Draws, Error> {
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

    /// Bytes of all outputs of a rollout before they are made PNG, and of what the spread is made of.
    fn output_bytes(
        &self,
        (candidates, samples, horizon): (u32, u32, u32),
        selection: Selection,
        spec: &ModelSpec,
    ) -> Result<u64, Error> {
        let Selection { wanted, depths, .. } = selection;
        let steps = match depths {
            Depths::Every(k) => u64::from(horizon / k),
            Depths::Last => 1,
        };
        let rows = u64::from(candidates) * u64::from(samples);
        let spread = u64::from(candidates) * steps * spread_bytes(wanted.spread, spec);
        let bytes = rows * steps * row_bytes(wanted.outputs, wanted.form, spec) + spread;
        let most = self.limits.max_output_bytes;
        if bytes > most {
            let found = format!("{bytes} bytes over {rows} rows and {steps} steps");
            let expected =
                format!("at most {most} bytes: fewer outputs, every_k, last_only, or U8");
            return Err(Error::invalid("outputs", found, expected));
        }
        Ok(bytes)
    }
}

/// Bytes of the outputs of one row at one step.
pub(super) fn row_bytes(outputs: Outputs, form: Form, spec: &ModelSpec) -> u64 {
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
