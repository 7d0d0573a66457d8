//! Cost programs and optimisers of the wire, checked field by field.

use std::sync::Arc;

use gatsbi_models::world_model::ModelSpec;
use gatsbi_proto::v1::{
    self, cost_term::Measure as Wire, plan_request::Optimiser as WireOptimiser, subject::Who,
};

use super::goals::Goal;
use crate::{
    bounds::{
        ITERATIONS, NOT_ALL, NOT_NEGATIVE, Numbers, ONE_OR_MORE, POSITIVE, SHARE, SOME, SPECTRUM,
        TERMS,
    },
    error::Error,
    planning::{
        cost::{Measure, Pixels, Program, Rect, Risk, Subject, Term, When},
        search::{Icem, Optimiser},
    },
};

/// Finds the goal with an id.
type FindGoal<'a> = &'a dyn Fn(&str) -> Result<Arc<Goal>, Error>;

/// A cost program.
///
/// # Errors
/// If a field is wrong, or a goal is not kept.
pub(super) fn program(
    asked: Option<v1::CostProgram>,
    spec: &ModelSpec,
    goals: FindGoal<'_>,
) -> Result<Program, Error> {
    let asked = asked.ok_or_else(|| Error::invalid("costs", "absent", "a cost program"))?;
    let count = |field: &str, found: usize, least: usize| {
        if (least..=TERMS).contains(&found) {
            return Ok(());
        }
        Err(Error::invalid(field, format!("{found} entries"), format!("{least} to {TERMS}")))
    };
    count("costs.terms", asked.terms.len(), 1)?;
    count("costs.constraints", asked.constraints.len(), 0)?;
    let risk = match v1::Risk::try_from(asked.risk) {
        Ok(v1::Risk::Unspecified | v1::Risk::Mean) => Risk::Mean,
        Ok(v1::Risk::Worst) => Risk::Worst,
        Ok(v1::Risk::WorstShare) => {
            let share = asked.worst_share.unwrap_or(0.25);
            Risk::WorstShare(SOME.check(share, "costs.worst_share")?)
        }
        Err(_) => return Err(Error::invalid("costs.risk", asked.risk, "a known risk")),
    };
    let mut terms = Vec::new();
    for (at, term) in asked.terms.into_iter().enumerate() {
        let field = format!("costs.terms[{at}]");
        let weight = finite(term.weight.unwrap_or(1.0), &format!("{field}.weight"))?;
        terms.push((self::term(term, &field, spec, goals)?, weight));
    }
    let mut constraints = Vec::new();
    for (at, constraint) in asked.constraints.into_iter().enumerate() {
        let field = format!("costs.constraints[{at}]");
        let most = finite(constraint.at_most, &format!("{field}.at_most"))?;
        let term = constraint.term.unwrap_or_default();
        constraints.push((self::term(term, &format!("{field}.term"), spec, goals)?, most));
    }
    Ok(Program {
        terms,
        constraints,
        discount: SOME.check(asked.discount.unwrap_or(1.0), "costs.discount")?,
        risk,
        missing: NOT_NEGATIVE
            .check(asked.missing_distance.unwrap_or(2.0), "costs.missing_distance")?,
    })
}

fn term(
    term: v1::CostTerm,
    field: &str,
    spec: &ModelSpec,
    goals: FindGoal<'_>,
) -> Result<Term, Error> {
    let when = match v1::When::try_from(term.when) {
        Ok(v1::When::Unspecified | v1::When::EveryStep) => When::EveryStep,
        Ok(v1::When::LastStep) => When::LastStep,
        Ok(v1::When::BestStep) => When::BestStep,
        Err(_) => {
            return Err(Error::invalid(format!("{field}.when"), term.when, "steps that count"));
        }
    };
    let measure = match term.measure {
        None => {
            return Err(Error::invalid(format!("{field}.measure"), "absent", "what is measured"));
        }
        Some(Wire::ToTarget(asked)) => {
            let field = format!("{field}.to_target");
            let target = asked
                .target
                .ok_or_else(|| Error::invalid(format!("{field}.target"), "absent", "a point"))?;
            Measure::ToTarget {
                subject: subject(asked.subject, &format!("{field}.subject"), spec)?,
                target: [
                    finite(target.x, &format!("{field}.target.x"))?,
                    finite(target.y, &format!("{field}.target.y"))?,
                ],
                tolerance: NOT_NEGATIVE.check(asked.tolerance, &format!("{field}.tolerance"))?,
                squared: squared(asked.distance, &format!("{field}.distance"))?,
            }
        }
        Some(Wire::Between(asked)) => {
            let field = format!("{field}.between");
            Measure::Between {
                a: subject(asked.a, &format!("{field}.a"), spec)?,
                b: subject(asked.b, &format!("{field}.b"), spec)?,
                distance: NOT_NEGATIVE
                    .check(asked.target_distance, &format!("{field}.target_distance"))?,
                squared: squared(asked.distance, &format!("{field}.distance"))?,
            }
        }
        Some(Wire::Region(asked)) => {
            let field = format!("{field}.region");
            Measure::Region {
                subject: subject(asked.subject, &format!("{field}.subject"), spec)?,
                region: rect(asked.r#box, &format!("{field}.box"))?,
                keep_out: asked.keep_out,
            }
        }
        Some(Wire::Overlap(asked)) => {
            let field = format!("{field}.overlap");
            Measure::Overlap {
                a: subject(asked.a, &format!("{field}.a"), spec)?,
                b: subject(asked.b, &format!("{field}.b"), spec)?,
            }
        }
        Some(Wire::ActionMagnitude(asked)) => Measure::ActionMagnitude {
            weights: weights(&asked.weights, &format!("{field}.action_magnitude.weights"), spec)?,
        },
        Some(Wire::ActionSmoothness(asked)) => {
            let field = format!("{field}.action_smoothness");
            let previous = match asked.previous.as_slice() {
                [] => None,
                previous => Some(numbers(previous, &format!("{field}.previous"), spec)?),
            };
            Measure::ActionSmoothness {
                weights: weights(&asked.weights, &format!("{field}.weights"), spec)?,
                previous,
            }
        }
        Some(Wire::Spread(asked)) => Measure::Spread {
            subject: subject(asked.subject, &format!("{field}.spread.subject"), spec)?,
        },
        Some(Wire::GoalImage(asked)) => {
            let field = format!("{field}.goal_image");
            let pixels = match v1::Pixels::try_from(asked.pixels) {
                Ok(v1::Pixels::Unspecified | v1::Pixels::All) => Pixels::All,
                Ok(v1::Pixels::Agent) => Pixels::Agent,
                Ok(v1::Pixels::Objects) => Pixels::Objects,
                Ok(v1::Pixels::Background) => Pixels::Background,
                Err(_) => {
                    let field = format!("{field}.pixels");
                    return Err(Error::invalid(field, asked.pixels, "known pixels"));
                }
            };
            if spec.agent_slot.is_none() && matches!(pixels, Pixels::Agent | Pixels::Background) {
                let expected = "all or objects: the model has no agent";
                return Err(Error::invalid(format!("{field}.pixels"), asked.pixels, expected));
            }
            let goal = goal(&asked.goal_id, &field, spec, goals)?;
            let image = goal.image.clone().ok_or_else(|| {
                Error::invalid(format!("{field}.goal_id"), &goal.id, "a goal with an image")
            })?;
            Measure::GoalImage { goal: image, pixels }
        }
        Some(Wire::GoalMasks(asked)) => {
            let field = format!("{field}.goal_masks");
            let part = part(asked.part, &format!("{field}.part"))?;
            let goal = goal(&asked.goal_id, &field, spec, goals)?;
            let goals = goal.masks.get(&part).cloned().ok_or_else(|| {
                let expected = format!("a goal with masks of {}", part.as_str_name());
                Error::invalid(format!("{field}.goal_id"), &goal.id, expected)
            })?;
            Measure::GoalMasks { goals }
        }
    };
    Ok(Term { measure, when })
}

/// A goal that was prepared for the model.
fn goal(id: &str, field: &str, spec: &ModelSpec, goals: FindGoal<'_>) -> Result<Arc<Goal>, Error> {
    let goal = goals(id)?;
    if goal.model_hash == spec.hash {
        return Ok(goal);
    }
    let found = format!("a goal for checkpoint {}", goal.model_hash);
    let expected = format!("one for the session's, {}", spec.hash);
    Err(Error::invalid(format!("{field}.goal_id"), found, expected))
}

/// Which part of a scene masks are of.
///
/// # Errors
/// If it is not known.
pub(super) fn part(part: i32, field: &str) -> Result<v1::MaskPart, Error> {
    match v1::MaskPart::try_from(part) {
        Ok(v1::MaskPart::Unspecified) => Ok(v1::MaskPart::AllObjects),
        Ok(part) => Ok(part),
        Err(_) => Err(Error::invalid(field, part, "a known part")),
    }
}

fn subject(asked: Option<v1::Subject>, field: &str, spec: &ModelSpec) -> Result<Subject, Error> {
    match asked.and_then(|asked| asked.who) {
        Some(Who::ObjectId(id)) => match i64::try_from(id) {
            Ok(id) => Ok(Subject::Object(id)),
            Err(_) => Err(unknown_object(field, id, &[])),
        },
        Some(Who::Agent(true)) if spec.agent_slot.is_some() => Ok(Subject::Agent),
        Some(Who::Agent(true)) => {
            Err(Error::invalid(format!("{field}.agent"), true, "an object: the model has no agent"))
        }
        Some(Who::AllObjects(true)) => Ok(Subject::AllObjects),
        Some(Who::Agent(false) | Who::AllObjects(false)) => {
            Err(Error::invalid(field, false, "object_id, agent or all_objects"))
        }
        None => Err(Error::invalid(field, "absent", "object_id, agent or all_objects")),
    }
}

/// An object that the belief does not hold.
fn unknown_object(field: &str, id: impl std::fmt::Display, known: &[i64]) -> Error {
    let known: Vec<String> = known.iter().map(i64::to_string).collect();
    let expected = if known.is_empty() {
        "an object of the belief, which holds none".to_owned()
    } else {
        format!("an object of the belief: {}", known.join(", "))
    };
    Error::invalid(format!("{field}.object_id"), id, expected)
}

/// Objects that a program names must be in the belief, whose slots hold `ids`.
///
/// # Errors
/// If one is not.
pub(super) fn objects_are_known(program: &Program, ids: &[i64]) -> Result<(), Error> {
    let known: Vec<i64> = ids.iter().copied().filter(|id| *id >= 0).collect();
    let check = |(term, _): &(Term, f32), field: String| {
        for subject in term.measure.subjects() {
            match subject {
                Subject::Object(id) if !known.contains(&id) => {
                    return Err(unknown_object(&field, id, &known));
                }
                _ => {}
            }
        }
        Ok(())
    };
    for (at, term) in program.terms.iter().enumerate() {
        check(term, format!("costs.terms[{at}]"))?;
    }
    for (at, constraint) in program.constraints.iter().enumerate() {
        check(constraint, format!("costs.constraints[{at}].term"))?;
    }
    Ok(())
}

fn rect(asked: Option<v1::Box>, field: &str) -> Result<Rect, Error> {
    let asked = asked.ok_or_else(|| Error::invalid(field, "absent", "a box"))?;
    let v1::Box { left, top, right, bottom } = asked;
    for (edge, name) in [(left, "left"), (top, "top"), (right, "right"), (bottom, "bottom")] {
        finite(edge, &format!("{field}.{name}"))?;
    }
    within(right, &format!("{field}.right"), &format!("more than left, {left}"), |x| x > left)?;
    within(bottom, &format!("{field}.bottom"), &format!("more than top, {top}"), |x| x > top)?;
    Ok(Rect([left, top, right, bottom]))
}

fn squared(distance: i32, field: &str) -> Result<bool, Error> {
    match v1::Distance::try_from(distance) {
        Ok(v1::Distance::Unspecified | v1::Distance::Euclidean) => Ok(false),
        Ok(v1::Distance::Squared) => Ok(true),
        Err(_) => Err(Error::invalid(field, distance, "a known distance")),
    }
}

/// Weights of action dimensions, their scales included.
fn weights(asked: &[f32], field: &str, spec: &ModelSpec) -> Result<Vec<f32>, Error> {
    let weights = match asked {
        [] => vec![1.0; spec.actions.len()],
        asked => numbers(asked, field, spec)?,
    };
    let scales = spec.actions.iter().map(|action| action.scale as f32);
    Ok(weights.iter().zip(scales).map(|(weight, scale)| weight / (scale * scale)).collect())
}

/// One number of each action dimension.
///
/// # Errors
/// If they are not as many, or one is not finite.
pub(super) fn numbers(asked: &[f32], field: &str, spec: &ModelSpec) -> Result<Vec<f32>, Error> {
    super::fields::action(asked, field, false, spec)
}

fn within(
    value: f32,
    field: &str,
    expected: &str,
    holds: impl Fn(f32) -> bool,
) -> Result<f32, Error> {
    if holds(value) { Ok(value) } else { Err(Error::invalid(field, value, expected)) }
}

fn finite(value: f32, field: &str) -> Result<f32, Error> {
    within(value, field, "a finite number", f32::is_finite)
}

/// An optimiser with at most `most` candidates.
///
/// # Errors
/// If a field is wrong.
pub(super) fn optimiser(asked: Option<WireOptimiser>, most: u32) -> Result<Optimiser, Error> {
    let count = |value: Option<u32>, usual: u32, range: (u32, u32), field: &str| {
        let (least, most) = range;
        let value = value.unwrap_or(usual.clamp(least, most));
        if (least..=most).contains(&value) {
            return Ok(value as usize);
        }
        Err(Error::invalid(field, value, format!("{least} to {most}")))
    };
    let number = |value: Option<f32>, usual: f32, field: &str, bounds: Numbers| {
        bounds.check(value.unwrap_or(usual), field).map(f64::from)
    };
    let iterations = |value: Option<u32>, usual: u32, field: &str| {
        ITERATIONS.check(value.unwrap_or(usual), field).map(|value| value as usize)
    };
    let cem = |asked: v1::Cem, field: &str, icem: Option<Icem>| {
        let at = |name: &str| format!("{field}.{name}");
        let candidates = count(asked.candidates, 256, (2, most), &at("candidates"))?;
        Ok(Optimiser::Cem {
            candidates,
            iterations: iterations(asked.iterations, 5, &at("iterations"))?,
            elites: count(asked.elites, 32, (1, candidates as u32 - 1), &at("elites"))?,
            initial_std: number(asked.initial_std, 0.5, &at("initial_std"), POSITIVE)?,
            min_std: number(asked.min_std, 0.05, &at("min_std"), NOT_NEGATIVE)?,
            momentum: number(asked.momentum, 0.1, &at("momentum"), NOT_ALL)?,
            icem,
        })
    };
    match asked.unwrap_or(WireOptimiser::Icem(v1::Icem::default())) {
        WireOptimiser::RandomShooting(asked) => Ok(Optimiser::RandomShooting {
            candidates: count(asked.candidates, 256, (1, most), "random_shooting.candidates")?,
        }),
        WireOptimiser::Cem(asked) => cem(asked, "cem", None),
        WireOptimiser::Icem(asked) => {
            let icem = Icem {
                beta: number(asked.noise_beta, 2.0, "icem.noise_beta", SPECTRUM)?,
                keep: number(asked.keep_elites, 0.3, "icem.keep_elites", SHARE)?,
                decay: number(asked.decay, 1.25, "icem.decay", ONE_OR_MORE)?,
            };
            cem(asked.cem.unwrap_or_default(), "icem.cem", Some(icem))
        }
        WireOptimiser::Mppi(asked) => Ok(Optimiser::Mppi {
            candidates: count(asked.candidates, 256, (1, most), "mppi.candidates")?,
            iterations: iterations(asked.iterations, 1, "mppi.iterations")?,
            temperature: number(asked.temperature, 0.5, "mppi.temperature", POSITIVE)?,
            std: number(asked.noise_std, 0.5, "mppi.noise_std", POSITIVE)?,
            beta: number(asked.noise_beta, 0.0, "mppi.noise_beta", SPECTRUM)?,
        }),
    }
}
