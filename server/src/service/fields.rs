//! Checks of request fields that several use cases share. Each knows the path of its field and what it may be.

use std::time::{Duration, Instant};

use gatsbi_models::{
    scene::{Output, Outputs},
    world_model::ModelSpec,
};
use gatsbi_proto::v1::{self, Encoding};

use crate::{
    bounds::ONE_OR_MORE,
    engine::commands::{Depths, Form, Wanted},
    error::{Error, FieldProblem},
};

/// What of a request is wanted, and how it is sent.
#[derive(Clone, Copy, Debug)]
pub(super) struct Selection {
    /// What the engine gives.
    pub(super) wanted: Wanted,
    /// Whether images and masks are sent as PNG.
    pub(super) png: bool,
    /// Which depths of a rollout.
    pub(super) depths: Depths,
}

/// For which kind of step outputs are wanted.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Steps {
    /// One observed step.
    Observed,
    /// Imagined steps up to this depth.
    Imagined {
        /// H.
        horizon: u32,
        /// S.
        samples: u32,
    },
    /// One imagined step.
    Stepped,
}

/// What a selection of outputs asks for.
///
/// # Errors
/// If it is contradictory or asks for what cannot be had.
pub(super) fn selection(
    asked: &v1::OutputSelection,
    steps: Steps,
    spec: &ModelSpec,
) -> Result<Selection, Error> {
    let imagined = steps != Steps::Observed;
    let (mut outputs, mut spread) = (Vec::new(), Vec::new());
    for (at, number) in asked.outputs.iter().enumerate() {
        let field = format!("outputs.outputs[{at}]");
        match over_samples(*number, &field, steps)? {
            Some(output) => spread.push(output),
            None => outputs.push(output(*number, &field, imagined, spec)?),
        }
    }
    if matches!(steps, Steps::Imagined { .. }) && asked.outputs.is_empty() {
        return Err(Error::invalid("outputs.outputs", "empty", "at least one output"));
    }
    let form = match Encoding::try_from(asked.encoding) {
        Ok(Encoding::Unspecified | Encoding::F32) => Form::F32,
        Ok(Encoding::F16) => Form::F16,
        Ok(Encoding::U8 | Encoding::Png) => Form::U8,
        Err(_) => {
            return Err(Error::invalid("outputs.encoding", asked.encoding, "a known encoding"));
        }
    };
    Ok(Selection {
        wanted: Wanted {
            outputs: Outputs::from_iter(outputs),
            form,
            spread: Outputs::from_iter(spread),
        },
        png: asked.encoding() == Encoding::Png,
        depths: depths(asked, steps)?,
    })
}

fn depths(asked: &v1::OutputSelection, steps: Steps) -> Result<Depths, Error> {
    match (steps, asked.every_k, asked.last_only) {
        (Steps::Observed | Steps::Stepped, Some(k), _) => {
            Err(Error::invalid("outputs.every_k", k, "absent: this is a single step"))
        }
        (Steps::Observed | Steps::Stepped, None, true) => {
            Err(Error::invalid("outputs.last_only", true, "absent: this is a single step"))
        }
        (Steps::Imagined { .. }, Some(k), true) => {
            Err(Error::invalid("outputs.every_k", k, "absent: last_only is set"))
        }
        (Steps::Imagined { horizon, .. }, Some(k), false) if !(1..=horizon).contains(&k) => {
            let expected = format!("1 to {horizon}, the horizon");
            Err(Error::invalid("outputs.every_k", k, expected))
        }
        (_, _, true) => Ok(Depths::Last),
        (_, k, false) => Ok(Depths::Every(k.unwrap_or(1))),
    }
}

/// What an output over samples is made of; nothing if it is none.
fn over_samples(number: i32, field: &str, steps: Steps) -> Result<Option<Output>, Error> {
    let Steps::Imagined { samples, .. } = steps else { return Ok(None) };
    let output = match v1::Output::try_from(number) {
        Ok(v1::Output::Spread) => Output::Frame,
        Ok(v1::Output::ObjectSpread) => Output::Objects,
        _ => return Ok(None),
    };
    if samples < 2 {
        let output = v1::Output::try_from(number).map_or("", |output| output.as_str_name());
        let reason = "it compares samples, of which there is only one";
        return Err(Error::OutputUnavailable { field: field.to_owned(), output, reason });
    }
    Ok(Some(output))
}

fn output(number: i32, field: &str, imagined: bool, spec: &ModelSpec) -> Result<Output, Error> {
    let Ok(asked) = v1::Output::try_from(number) else {
        return Err(Error::invalid(field, number, "a known output"));
    };
    let output = match asked {
        v1::Output::Unspecified => {
            return Err(Error::invalid(field, asked.as_str_name(), "a known output"));
        }
        v1::Output::Frame => Output::Frame,
        v1::Output::AgentMask => Output::AgentMask,
        v1::Output::SlotMasks => Output::SlotMasks,
        v1::Output::ObjectMasks => Output::ObjectMasks,
        v1::Output::Background => Output::Background,
        v1::Output::Objects => Output::Objects,
        v1::Output::Latents => Output::Latents,
        v1::Output::Surprise => Output::Surprise,
        v1::Output::LogLikelihood => Output::LogLikelihood,
        v1::Output::Keypoints => Output::Keypoints,
        v1::Output::Spread | v1::Output::ObjectSpread => {
            let (field, output) = (field.to_owned(), asked.as_str_name());
            let reason = "it compares samples of a rollout";
            return Err(Error::OutputUnavailable { field, output, reason });
        }
        v1::Output::Costs => return Err(Error::Unimplemented { what: "costs of rollouts" }),
    };
    let reason = match output {
        output if output.needs_frame() && imagined => "it compares a step with its image",
        Output::AgentMask if spec.agent_slot.is_none() => "the model has no agent",
        Output::Keypoints if spec.keypoints.is_none() => "the model has no detector",
        _ => return Ok(output),
    };
    let (field, output) = (field.to_owned(), asked.as_str_name());
    Err(Error::OutputUnavailable { field, output, reason })
}

/// The output as the wire names it.
pub(super) fn output_name(output: Output) -> v1::Output {
    match output {
        Output::Frame => v1::Output::Frame,
        Output::AgentMask => v1::Output::AgentMask,
        Output::SlotMasks => v1::Output::SlotMasks,
        Output::ObjectMasks => v1::Output::ObjectMasks,
        Output::Background => v1::Output::Background,
        Output::Objects => v1::Output::Objects,
        Output::Latents => v1::Output::Latents,
        Output::Surprise => v1::Output::Surprise,
        Output::LogLikelihood => v1::Output::LogLikelihood,
        Output::Keypoints => v1::Output::Keypoints,
    }
}

/// The action of an observation.
///
/// # Errors
/// If it has another dimension than the model's, or numbers that are not finite.
pub(super) fn action(
    action: &[f32],
    field: &str,
    may_be_absent: bool,
    spec: &ModelSpec,
) -> Result<Vec<f32>, Error> {
    if action.is_empty() && may_be_absent {
        return Ok(spec.neutral_action());
    }
    if action.len() != spec.actions.len() {
        let found = format!("{} numbers", action.len());
        let names: Vec<&str> = spec.actions.iter().map(|action| action.name.as_str()).collect();
        let expected = format!("{} numbers ({})", names.len(), names.join(", "));
        return Err(Error::invalid(field, found, expected));
    }
    match action.iter().position(|x| !x.is_finite()) {
        Some(at) => Err(Error::invalid(format!("{field}[{at}]"), action[at], "a finite number")),
        None => Ok(action.to_vec()),
    }
}

/// Whether random numbers are drawn.
///
/// # Errors
/// If the mode is not known.
pub(super) fn samples(mode: i32, field: &str) -> Result<bool, Error> {
    match v1::Mode::try_from(mode) {
        Ok(v1::Mode::Mean) => Ok(false),
        Ok(v1::Mode::Sample | v1::Mode::Unspecified) => Ok(true),
        Err(_) => Err(Error::invalid(field, mode, "a known mode")),
    }
}

/// A seed that every JSON reader keeps.
pub(super) fn random_seed() -> u64 {
    rand::random::<u64>() >> 11
}

/// When a request is of no use any more: what it says itself, or what the call says, whichever is earlier.
///
/// # Errors
/// If it asks for an answer before it was sent.
pub(super) fn deadline(
    timeout_millis: Option<u32>,
    call: Option<Instant>,
) -> Result<Option<Instant>, Error> {
    let own = match timeout_millis {
        Some(millis) => {
            let millis = ONE_OR_MORE.check(millis, "timeout_millis")?;
            Some(Instant::now() + Duration::from_millis(millis.into()))
        }
        None => None,
    };
    Ok(own.into_iter().chain(call).min())
}

/// The first step's problems, all of them.
pub(super) fn all(problems: Vec<Option<FieldProblem>>) -> Result<(), Error> {
    let problems: Vec<FieldProblem> = problems.into_iter().flatten().collect();
    if problems.is_empty() { Ok(()) } else { Err(Error::InvalidFields(problems)) }
}

/// A problem unless something holds.
pub(super) fn unless(
    holds: bool,
    field: &str,
    value: impl std::fmt::Display,
    expected: impl Into<String>,
) -> Option<FieldProblem> {
    (!holds).then(|| FieldProblem::new(field, value, expected))
}
