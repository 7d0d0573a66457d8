//! Planning: what candidates cost, and which actions cost least. Nothing but costs leaves the engine's side.

use std::time::{Duration, Instant};

use gatsbi_models::{
    scene::{Output, Outputs},
    world_model::ModelSpec,
};
use gatsbi_proto::v1::{self, output_value::Value as Wire, warm_start::From};

use super::{
    Call, Service, answer, fields,
    imagine::{Asked, Draws, row_bytes},
    programs,
};
use crate::{
    bounds::ONE_OR_MORE,
    engine::commands::{Chunk, Depths, Form, Imagine, NumberType, Spent, Tenant, Urgency, Wanted},
    error::Error,
    planning::{
        cost::Program,
        measure::{Pictures, Seen, Step},
        scores::{Measured, Scores, Size},
        search::{Rank, Search, Space},
    },
    sessions::session::{Planned, Position, Session},
    telemetry, tensor,
};

/// What candidates are measured by, and from where.
struct Question<'a> {
    program: &'a Program,
    position: &'a Position,
    draws: Draws,
    tenant: Tenant,
    horizon: u32,
    deadline: Option<Instant>,
}

impl Service {
    /// What candidates cost.
    ///
    /// # Errors
    /// If the request is wrong, the session has moved, or there is too much to do already.
    pub async fn score(
        &self,
        request: v1::ScoreRequest,
        call: Call,
    ) -> Result<v1::ScoreResponse, Error> {
        let session = self.session(&request.session_id)?;
        let position = session.position();
        let spec = &position.model.spec;
        let program = programs::program(request.costs, spec, &|id| self.goal(id))?;
        let (actions, candidates, horizon) = self.actions(request.actions, spec)?;
        let draws = self.draws(request.sampling.unwrap_or_default())?;
        let at_step = position.last(request.at_step)?;
        let question = Question {
            program: &program,
            position: &position,
            draws,
            tenant: call.tenant.unwrap_or(Tenant(session.id.bits())),
            horizon,
            deadline: fields::deadline(request.timeout_millis, call.deadline)?,
        };
        let (scores, spent) = self.measure(&question, &actions, candidates).await?;
        let ranks = ranks(&scores);
        let best = (0..ranks.len()).min_by(|a, b| ranks[*a].order(&ranks[*b])).unwrap_or(0);
        let constrained = !program.constraints.is_empty();
        let list = |shape: &[u32], numbers: &[f32]| Some(tensor::of_floats(shape, numbers));
        Ok(v1::ScoreResponse {
            at_step,
            model_hash: spec.hash.clone(),
            seed: draws.seed.unwrap_or(0),
            costs: list(&[candidates], &scores.costs),
            violations: constrained.then(|| list(&[candidates], &scores.violations)).flatten(),
            by_sample: request
                .by_sample
                .then(|| list(&[candidates, draws.samples], &scores.by_sample))
                .flatten(),
            by_term: request
                .by_term
                .then(|| list(&[candidates, program.terms.len() as u32], &scores.by_term))
                .flatten(),
            best: best as u32,
            timing: Some(answer::timing(spent, Duration::ZERO)),
        })
    }

    /// The actions that cost least, as far as an optimiser finds them in time.
    ///
    /// # Errors
    /// If the request is wrong, the session has moved or is deleted meanwhile, or not even one iteration is done in
    /// time.
    pub async fn find_plan(
        &self,
        request: v1::PlanRequest,
        call: Call,
    ) -> Result<v1::PlanResponse, Error> {
        let session = self.session(&request.session_id)?;
        let position = session.position();
        let spec = &position.model.spec;
        let space = self.space(&request, spec)?;
        let program = programs::program(request.costs, spec, &|id| self.goal(id))?;
        let optimiser = programs::optimiser(request.optimiser, self.limits.max_candidates)?;
        let sampling = request.sampling.unwrap_or_default();
        let seed = sampling.seed.unwrap_or_else(fields::random_seed);
        // The optimiser draws even where futures do not.
        let drawn = fields::samples(sampling.mode, "sampling.mode")?;
        let draws = self.draws(v1::Sampling { seed: drawn.then_some(seed), ..sampling })?;
        let at_step = position.last(request.at_step)?;
        let start = start_of(request.warm_start, &session, at_step, &space)?;
        let budget = request.budget_millis;
        let budget = budget.map(|millis| ONE_OR_MORE.check(millis, "budget_millis")).transpose()?;
        let question = Question {
            program: &program,
            position: &position,
            draws,
            tenant: call.tenant.unwrap_or(Tenant(session.id.bits())),
            horizon: request.horizon,
            deadline: fields::deadline(budget, call.deadline)?,
        };
        let wanted = request.outputs.map(|outputs| Asked {
            actions: None,
            sampling: Some(v1::Sampling { seed: draws.seed, samples: None, ..sampling }),
            outputs: Some(outputs),
            costs: None,
        });

        let mut search = Search::new(space, optimiser, seed, start.as_deref());
        let (mut best_costs, mut evaluated, mut spent) = (Vec::new(), 0, Spent::default());
        let mut stop = v1::StopReason::Iterations;
        while search.done() < search.iterations() {
            let (actions, candidates) = search.propose();
            let measured = self.measure(&question, &actions, candidates as u32).await;
            let (scores, took) = match measured {
                Err(Error::DeadlineExceeded | Error::TooSlow { .. }) if search.done() > 0 => {
                    stop = v1::StopReason::Budget;
                    break;
                }
                measured => measured?,
            };
            spent.queue += took.queue;
            spent.compute += took.compute;
            spent.encode += took.encode;
            evaluated += candidates as u32;
            search.learn(&ranks(&scores));
            best_costs.extend(search.best().map(|best| best.rank.cost));
            // Who deletes a session does not wait for its plans.
            self.session(&request.session_id)?;
        }
        let best = search.best().ok_or(Error::DeadlineExceeded)?;
        let width = spec.actions.len() as u32;
        let shape = [request.horizon, width];
        let actions = tensor::of_floats(&shape, &best.actions);
        let (outputs, depths) = match wanted {
            Some(asked) => {
                let asked = Asked { actions: Some(actions.clone()), ..asked };
                let plan = self.plan(asked, spec)?;
                let live = (question.tenant, Urgency::Live);
                let mut rollout = self.roll_out(plan, &position, live, call.deadline).await?;
                let mut chunks = Vec::new();
                while let Some(chunk) = rollout.next().await {
                    chunks.push(chunk?);
                }
                along_depths(chunks)
            }
            None => (Vec::new(), Vec::new()),
        };
        session.plan(Planned { at_step, actions: best.actions.into() });
        Ok(v1::PlanResponse {
            at_step,
            model_hash: spec.hash.clone(),
            seed,
            actions: Some(actions),
            cost: best.rank.cost,
            violation: best.rank.violation,
            std: Some(tensor::of_floats(&shape, &search.std())),
            best_costs,
            iterations: search.done() as u32,
            candidates: evaluated,
            stop: stop.into(),
            outputs,
            depths,
            timing: Some(answer::timing(spent, Duration::ZERO)),
        })
    }

    fn space(&self, request: &v1::PlanRequest, spec: &ModelSpec) -> Result<Space, Error> {
        let most = self.limits.max_horizon;
        if !(1..=most).contains(&request.horizon) {
            return Err(Error::invalid("horizon", request.horizon, format!("1 to {most} steps")));
        }
        let repeat = request.action_repeat.unwrap_or(1);
        if !(1..=request.horizon).contains(&repeat) {
            let expected = format!("1 to {}, the horizon", request.horizon);
            return Err(Error::invalid("action_repeat", repeat, expected));
        }
        let limit = |asked: &[f32], field: &str, scales: f64| match asked {
            [] => {
                let limit = |action: &gatsbi_models::world_model::ActionDimension| {
                    (action.offset + scales * action.scale) as f32
                };
                Ok(spec.actions.iter().map(limit).collect())
            }
            asked => programs::numbers(asked, field, spec),
        };
        let min: Vec<f32> = limit(&request.action_min, "action_min", -2.0)?;
        let max: Vec<f32> = limit(&request.action_max, "action_max", 2.0)?;
        fields::all(
            min.iter()
                .zip(&max)
                .enumerate()
                .map(|(at, (min, max))| {
                    let expected = format!("more than action_min[{at}], {min}");
                    fields::unless(max > min, &format!("action_max[{at}]"), max, expected)
                })
                .collect(),
        )?;
        Ok(Space { min, max, horizon: request.horizon as usize, repeat: repeat as usize })
    }

    /// Imagines candidates, `[N, H, A]` in raw units, and measures them.
    async fn measure(
        &self,
        question: &Question<'_>,
        actions: &[f32],
        candidates: u32,
    ) -> Result<(Scores, Spent), Error> {
        let Question { program, position, draws, horizon, .. } = *question;
        let spec = &position.model.spec;
        let rows = candidates * draws.samples;
        if rows > self.limits.max_rows {
            let found = format!("{candidates} candidates x {} samples", draws.samples);
            let expected = format!("at most {} rows", self.limits.max_rows);
            return Err(Error::invalid("sampling.samples", found, expected));
        }
        let size = Size {
            candidates: candidates as usize,
            samples: draws.samples as usize,
            horizon: horizon as usize,
            slots: spec.max_objects as usize,
        };
        let mut measured = Measured::new(program, size);
        let mut spent = Spent::default();
        let outputs = program.outputs();
        // Costs of actions alone need no model.
        if outputs != Outputs::default() {
            let wanted = Wanted { outputs, form: Form::U8, spread: Outputs::default() };
            let bytes =
                u64::from(rows) * u64::from(horizon) * row_bytes(wanted.outputs, wanted.form, spec);
            let most = self.limits.max_output_bytes;
            if bytes > most {
                let found = format!("{bytes} bytes of masks and objects over {rows} rows");
                let expected = format!("at most {most} bytes: fewer candidates, samples or steps");
                return Err(Error::invalid("costs", found, expected));
            }
            let job = Imagine {
                model: position.model.clone(),
                tenant: question.tenant,
                starts: draws.starts(position, candidates),
                actions: actions.into(),
                candidates,
                horizon,
                wanted,
                depths: Depths::Every(1),
                states: false,
                deadline: question.deadline,
                urgency: Urgency::Live,
            };
            let mut chunks = self.roll(job, bytes).await?;
            loop {
                let chunk = chunks.next().await.unwrap_or(Err(Error::ShuttingDown))?;
                telemetry::waited(telemetry::Kind::Imagine, chunk.spent.queue);
                spent.queue += chunk.spent.queue;
                spent.compute += chunk.spent.compute;
                spent.encode += chunk.spent.encode;
                add(&mut measured, program, &chunk)?;
                if chunk.last {
                    break;
                }
            }
        }
        Ok((measured.scores(actions), spent))
    }
}

/// What a search begins around, `[H, A]`.
fn start_of(
    asked: Option<v1::WarmStart>,
    session: &Session,
    at_step: u64,
    space: &Space,
) -> Result<Option<Vec<f32>>, Error> {
    let width = space.min.len();
    match asked.and_then(|asked| asked.from) {
        Some(From::Actions(actions)) => {
            let expected = [space.horizon as u32, width as u32];
            if actions.shape != expected {
                let found = format!("{:?}", actions.shape);
                let field = "warm_start.actions.shape";
                return Err(Error::invalid(field, found, format!("{expected:?}")));
            }
            Ok(Some(tensor::floats(&actions, "warm_start.actions")?))
        }
        Some(From::Previous(true)) => {
            // A plan of a time that was taken back says nothing.
            let planned = session.planned().filter(|planned| planned.at_step <= at_step);
            Ok(planned.map(|planned| moved_on(&planned, at_step, (space.horizon, width))))
        }
        Some(From::Previous(false)) | None => Ok(None),
    }
}

fn ranks(scores: &Scores) -> Vec<Rank> {
    let ranks = scores.costs.iter().zip(&scores.violations);
    ranks.map(|(cost, violation)| Rank { violation: *violation, cost: *cost }).collect()
}

/// Measures the rows of a chunk.
///
/// # Errors
/// If the program names an object that is not in the belief.
fn add(measured: &mut Measured<'_>, program: &Program, chunk: &Chunk) -> Result<(), Error> {
    let candidates = chunk.candidates as usize;
    let value = |output: Output, numbers: NumberType| {
        chunk.values.iter().find(|value| value.output == output && value.numbers == numbers)
    };
    let ids: Vec<i64> = value(Output::Objects, NumberType::I64).map_or_else(Vec::new, |value| {
        value.data.as_chunks::<8>().0.iter().map(|bytes| i64::from_le_bytes(*bytes)).collect()
    });
    let table: Vec<f32> = value(Output::Objects, NumberType::F32).map_or_else(Vec::new, |value| {
        value.data.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
    });
    let picture = |output: Output| value(output, NumberType::U8);
    let bytes = |output: Output| picture(output).map_or(&[][..], |value| &value.data[..]);
    let (frames, masks) = (bytes(Output::Frame), bytes(Output::ObjectMasks));
    let agents = bytes(Output::AgentMask);
    for row in 0..candidates {
        let of = |all: usize| row * all / candidates..(row + 1) * all / candidates;
        let ids = &ids[of(ids.len())];
        if chunk.depth == 1 && row == 0 {
            // Nothing is discovered on the way, so the first step has the objects of the belief.
            programs::objects_are_known(program, ids)?;
        }
        let pictures = Pictures {
            frame: &frames[of(frames.len())],
            agent: &agents[of(agents.len())],
            objects: &masks[of(masks.len())],
        };
        let agent = picture(Output::AgentMask).and_then(|value| {
            let mask: Vec<f32> = pictures.agent.iter().map(|x| f32::from(*x) / 255.0).collect();
            Seen::of_mask(&mask, *value.shape.last()?)
        });
        let at =
            (chunk.first_candidate as usize + row, chunk.sample as usize, chunk.depth as usize - 1);
        measured.add(at, Step { ids, table: &table[of(table.len())], agent, pictures });
    }
    Ok(())
}

/// A plan without the steps that were taken since; its last action fills what is missing.
fn moved_on(planned: &Planned, at_step: u64, (horizon, width): (usize, usize)) -> Vec<f32> {
    let steps: Vec<&[f32]> = planned.actions.chunks(width).collect();
    let since = usize::try_from(at_step - planned.at_step).unwrap_or(usize::MAX);
    let last = steps.len() - 1;
    (0..horizon).flat_map(|t| steps[since.saturating_add(t).min(last)]).copied().collect()
}

/// Chunks of one row as outputs with an axis of depths, and these.
fn along_depths(mut chunks: Vec<v1::RolloutChunk>) -> (Vec<v1::OutputValue>, Vec<u32>) {
    chunks.sort_by_key(|chunk| chunk.depths.first().copied());
    let depths = chunks.iter().flat_map(|chunk| chunk.depths.clone()).collect();
    let mut chunks = chunks.into_iter().map(|chunk| chunk.outputs);
    let mut outputs = chunks.next().unwrap_or_default();
    for chunk in chunks {
        for (whole, part) in outputs.iter_mut().zip(chunk) {
            match (&mut whole.value, part.value) {
                (Some(Wire::Tensor(whole)), Some(Wire::Tensor(part))) => append(whole, &part),
                (Some(Wire::Images(whole)), Some(Wire::Images(part))) => {
                    whole.shape[1] += 1;
                    whole.png.extend(part.png);
                }
                (Some(Wire::Tracks(whole)), Some(Wire::Tracks(part))) => {
                    let pairs = [(&mut whole.ids, part.ids), (&mut whole.values, part.values)];
                    for (whole, part) in pairs {
                        if let (Some(whole), Some(part)) = (whole.as_mut(), part) {
                            append(whole, &part);
                        }
                    }
                }
                _ => {}
            }
        }
    }
    (outputs, depths)
}

/// Puts a tensor of `[1, 1, ...]` behind one of `[1, depths, ...]`.
fn append(whole: &mut v1::Tensor, part: &v1::Tensor) {
    whole.shape[1] += 1;
    whole.data = [whole.data.as_ref(), part.data.as_ref()].concat().into();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_moves_on_with_the_session() {
        let planned = Planned { at_step: 4, actions: [1.0, -1.0, 2.0, -2.0, 3.0, -3.0].into() };
        let moved = |at_step, horizon| moved_on(&planned, at_step, (horizon, 2));
        assert_eq!(moved(4, 3), *planned.actions);
        assert_eq!(moved(5, 3), [2.0, -2.0, 3.0, -3.0, 3.0, -3.0]);
        assert_eq!(moved(5, 1), [2.0, -2.0]);
        assert_eq!(moved(u64::MAX, 2), [3.0, -3.0, 3.0, -3.0]);
    }
}
