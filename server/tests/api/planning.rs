//! Planning next to the model, on both APIs: costs are what rollouts say, plans are reproducible and cost less.

#![expect(clippy::unnecessary_wraps, reason = "fields of messages are options")]

use gatsbi_proto::v1::{self, Output, cost_term::Measure, output_value::Value, subject::Who};
use serde_json::json;
use tonic::{Code, Status};
use tonic_types::StatusExt as _;

use crate::support::{ACTION, TestServer, actions, f32_tensor, floats, outputs, rollout, u8_image};

fn agent() -> Option<v1::Subject> {
    Some(v1::Subject { who: Some(Who::Agent(true)) })
}

fn object(id: u64) -> Option<v1::Subject> {
    Some(v1::Subject { who: Some(Who::ObjectId(id)) })
}

fn term(measure: Measure) -> v1::CostTerm {
    v1::CostTerm { measure: Some(measure), ..Default::default() }
}

fn to_target(subject: Option<v1::Subject>, x: f32, y: f32) -> v1::CostTerm {
    let target = Some(v1::Point { x, y });
    term(Measure::ToTarget(v1::ToTarget { subject, target, ..Default::default() }))
}

fn costs(terms: Vec<v1::CostTerm>) -> Option<v1::CostProgram> {
    Some(v1::CostProgram { terms, ..Default::default() })
}

fn seeded(seed: u64, samples: u32) -> Option<v1::Sampling> {
    Some(v1::Sampling { seed: Some(seed), samples: Some(samples), ..Default::default() })
}

fn score(session: &v1::Session, terms: Vec<v1::CostTerm>) -> v1::ScoreRequest {
    v1::ScoreRequest {
        session_id: session.id.clone(),
        actions: Some(f32_tensor(&[4, 3, ACTION as u32], &actions(4, 3, 3))),
        sampling: seeded(11, 1),
        costs: costs(terms),
        ..Default::default()
    }
}

fn plan(session: &v1::Session, terms: Vec<v1::CostTerm>) -> v1::PlanRequest {
    let cem = v1::Cem {
        candidates: Some(16),
        elites: Some(4),
        iterations: Some(3),
        ..Default::default()
    };
    let icem = v1::Icem { cem: Some(cem), ..Default::default() };
    v1::PlanRequest {
        session_id: session.id.clone(),
        horizon: 3,
        costs: costs(terms),
        sampling: seeded(5, 1),
        optimiser: Some(v1::plan_request::Optimiser::Icem(icem)),
        ..Default::default()
    }
}

async fn ask(server: &TestServer, request: v1::PlanRequest) -> Result<v1::PlanResponse, Status> {
    Ok(server.planning.clone().plan(request).await?.into_inner())
}

/// The one field that a refused request is refused for.
fn field(status: &Status) -> String {
    assert_eq!(status.code(), Code::InvalidArgument, "{status:?}");
    let details = status.get_error_details();
    details.bad_request().unwrap().field_violations[0].field.clone()
}

/// The middle of an agent's mask `[64, 64]`, in [-1, 1].
fn centre(mask: &[u8]) -> [f32; 2] {
    let (mut sum, mut x, mut y) = (0.0f64, 0.0f64, 0.0f64);
    for (at, share) in mask.iter().enumerate() {
        let share = f64::from(*share);
        sum += share;
        x += share * ((at % 64) as f64 + 0.5);
        y += share * ((at / 64) as f64 + 0.5);
    }
    [x, y].map(|at| (at / sum / 32.0 - 1.0) as f32)
}

#[tokio::test]
async fn costs_are_what_rollouts_say() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 2).await;
    let masks = Some(outputs(&[Output::AgentMask], v1::Encoding::U8));
    let request = v1::ImagineRequest { outputs: masks, ..rollout(&session, 4, 3) };
    let mut expected = [0.0f32; 4];
    for chunk in server.imagine(request).await.unwrap() {
        let Some(Value::Tensor(mask)) = &chunk.outputs[0].value else {
            panic!("masks are tensors")
        };
        for (at, mask) in mask.data.chunks_exact(64 * 64).enumerate() {
            let [x, y] = centre(mask);
            expected[chunk.first_candidate as usize + at] += (x - 0.5).hypot(y + 0.25) / 3.0;
        }
    }
    let magnitude = term(Measure::ActionMagnitude(v1::ActionMagnitude::default()));
    let magnitude = v1::CostTerm { weight: Some(0.0), ..magnitude };
    let request = score(&session, vec![to_target(agent(), 0.5, -0.25), magnitude]);
    let request = v1::ScoreRequest { by_term: true, by_sample: true, ..request };
    let answer = server.planning.clone().score(request).await.unwrap().into_inner();
    let found = floats(answer.costs.as_ref().unwrap());
    for (found, expected) in found.iter().zip(expected) {
        assert!((found - expected).abs() < 1e-4, "{found}, expected {expected}");
    }
    let cheapest = (0..4).min_by(|a, b| found[*a].total_cmp(&found[*b])).unwrap();
    assert_eq!(answer.best as usize, cheapest);
    assert_eq!(answer.by_term.unwrap().shape, [4, 2]);
    assert_eq!(floats(&answer.by_sample.unwrap()), found);
    assert_eq!((answer.violations, answer.at_step, answer.seed), (None, 1, 11));
    assert_eq!(server.next_step(&session).await, 2);
    server.app.shutdown().await;
}

#[tokio::test]
async fn plans_are_reproducible_and_cost_what_they_say() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 2).await;
    let request = v1::PlanRequest {
        outputs: Some(outputs(&[Output::Frame, Output::Objects], v1::Encoding::U8)),
        ..plan(&session, vec![to_target(agent(), 0.5, -0.25)])
    };
    let one = ask(&server, request.clone()).await.unwrap();
    let again = ask(&server, request.clone()).await.unwrap();
    let without = |answer: &v1::PlanResponse| v1::PlanResponse { timing: None, ..answer.clone() };
    assert_eq!(without(&one), without(&again));
    assert_eq!(one.stop(), v1::StopReason::Iterations);
    assert_eq!((one.iterations, one.depths.as_slice()), (3, [1, 2, 3].as_slice()));
    assert!(one.best_costs.is_sorted_by(|a, b| a >= b), "{:?}", one.best_costs);
    let Some(Value::Tensor(frames)) = &one.outputs[0].value else { panic!("frames are tensors") };
    assert_eq!(
        (frames.shape.as_slice(), frames.data.len()),
        ([1, 3, 64, 64, 3].as_slice(), 3 * 64 * 64 * 3)
    );
    let Some(Value::Tracks(tracks)) = &one.outputs[1].value else {
        panic!("objects come as tracks")
    };
    assert_eq!(tracks.values.as_ref().unwrap().shape, [1, 3, 7, 6]);

    let found = floats(one.actions.as_ref().unwrap());
    let scored = v1::ScoreRequest {
        actions: Some(f32_tensor(&[1, 3, ACTION as u32], &found)),
        sampling: seeded(5, 1),
        ..score(&session, vec![to_target(agent(), 0.5, -0.25)])
    };
    let scored = server.planning.clone().score(scored).await.unwrap().into_inner();
    let cost = floats(&scored.costs.unwrap())[0];
    assert!((cost - one.cost).abs() < 1e-5, "{cost}, the plan says {}", one.cost);

    // The next plan starts from this one and can only be better.
    let previous = v1::WarmStart { from: Some(v1::warm_start::From::Previous(true)) };
    let next = v1::PlanRequest { warm_start: Some(previous), ..request };
    let next = ask(&server, next).await.unwrap();
    assert!(next.best_costs[0] <= one.cost + 1e-5, "{:?} after {}", next.best_costs, one.cost);
    server.app.shutdown().await;
}

#[tokio::test]
async fn plans_keep_to_limits_and_constraints_on_rest_too() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 2).await;
    let path = format!("/v1/sessions/{}/plans", session.id);
    let body = json!({
        "horizon": 4, "actionRepeat": 2,
        "actionMin": [-0.5, -1, -1, -1, -1, -1, -1], "actionMax": [0.5, 1, 1, 1, 1, 1, 1],
        "costs": {
            "terms": [{"actionMagnitude": {"weights": [-1, 0, 0, 0, 0, 0, 0]}}],
            "constraints": [{"term": {"actionMagnitude": {"weights": [0, 1, 0, 0, 0, 0, 0]}}, "atMost": 0.01}],
        },
        "cem": {"candidates": 200, "elites": 20, "iterations": 8}, "sampling": {"seed": "3", "mode": "MODE_MEAN"},
    });
    let (status, answer) = server.post_json(&path, &body).await;
    assert_eq!(status, 200, "{answer}");
    let violation = answer["violation"].as_f64().unwrap_or(0.0);
    assert!(violation < 1e-6, "{answer}");
    let accept = server.post(&path).header("accept", "application/x-protobuf").json(&body);
    let bytes = accept.send().await.unwrap().bytes().await.unwrap();
    let plan = <v1::PlanResponse as prost::Message>::decode(bytes).unwrap();
    let actions = floats(&plan.actions.unwrap());
    let steps: Vec<&[f32]> = actions.chunks(ACTION).collect();
    assert!(steps[0] == steps[1] && steps[2] == steps[3]);
    assert!(steps.iter().all(|step| step[0].abs() > 0.45 && step[0].abs() <= 0.5), "{steps:?}");
    server.app.shutdown().await;
}

#[tokio::test]
async fn what_is_wrong_with_a_plan_is_told_by_field() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 2).await;
    let good = || plan(&session, vec![to_target(agent(), 0.0, 0.0)]);
    let refused = async |request: v1::PlanRequest| field(&ask(&server, request).await.unwrap_err());
    let of = |term: v1::CostTerm| v1::PlanRequest { costs: costs(vec![term]), ..good() };
    assert_eq!(refused(of(to_target(object(9999), 0.0, 0.0))).await, "costs.terms[0].object_id");
    assert_eq!(refused(of(to_target(None, 0.0, 0.0))).await, "costs.terms[0].to_target.subject");
    assert_eq!(
        refused(of(to_target(agent(), f32::NAN, 0.0))).await,
        "costs.terms[0].to_target.target.x"
    );
    assert_eq!(refused(of(v1::CostTerm::default())).await, "costs.terms[0].measure");
    let upside_down = v1::Box { left: 0.0, top: 0.5, right: 1.0, bottom: -0.5 };
    let region = v1::Region { subject: agent(), r#box: Some(upside_down), keep_out: false };
    assert_eq!(
        refused(of(term(Measure::Region(region)))).await,
        "costs.terms[0].region.box.bottom"
    );
    assert_eq!(refused(v1::PlanRequest { costs: None, ..good() }).await, "costs");
    assert_eq!(refused(v1::PlanRequest { horizon: 0, ..good() }).await, "horizon");
    assert_eq!(
        refused(v1::PlanRequest { action_repeat: Some(4), ..good() }).await,
        "action_repeat"
    );
    let crossed =
        v1::PlanRequest { action_min: vec![1.0; ACTION], action_max: vec![-1.0; ACTION], ..good() };
    assert_eq!(refused(crossed).await, "action_max[0]");
    assert_eq!(
        refused(v1::PlanRequest { action_min: vec![f32::NAN; ACTION], ..good() }).await,
        "action_min[0]"
    );
    assert_eq!(
        refused(v1::PlanRequest { budget_millis: Some(0), ..good() }).await,
        "budget_millis"
    );
    let many = v1::RandomShooting { candidates: Some(1 << 30) };
    let many = v1::plan_request::Optimiser::RandomShooting(many);
    assert_eq!(
        refused(v1::PlanRequest { optimiser: Some(many), ..good() }).await,
        "random_shooting.candidates"
    );
    assert_eq!(
        refused(v1::PlanRequest { sampling: seeded(1, 100_000), ..good() }).await,
        "sampling.samples"
    );
    let unknown = ask(&server, v1::PlanRequest { session_id: "nope".to_owned(), ..good() }).await;
    assert_eq!(unknown.unwrap_err().code(), Code::NotFound);
    assert_eq!(server.next_step(&session).await, 2);
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_budget_gives_the_best_so_far() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 2).await;
    let cem = v1::Cem {
        candidates: Some(16),
        elites: Some(4),
        iterations: Some(100),
        ..Default::default()
    };
    let request = v1::PlanRequest {
        optimiser: Some(v1::plan_request::Optimiser::Cem(cem)),
        budget_millis: Some(3000),
        ..plan(&session, vec![to_target(agent(), 0.5, 0.0)])
    };
    let answer = ask(&server, request).await.unwrap();
    let done = answer.iterations;
    let expected = if done < 100 { v1::StopReason::Budget } else { v1::StopReason::Iterations };
    assert!(answer.stop() == expected && done >= 1, "{done} iterations, {:?}", answer.stop());
    assert_eq!((answer.best_costs.len() as u32, answer.candidates), (done, 16 * done));
    server.app.shutdown().await;
}

#[tokio::test]
async fn goals_are_kept_and_reached() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 2).await;
    let mut planning = server.planning.clone();
    let wanted = Some(outputs(&[Output::Frame, Output::AgentMask], v1::Encoding::U8));
    let request = v1::ImagineRequest { outputs: wanted, ..rollout(&session, 4, 3) };
    // What the third candidate leads to is the goal.
    let mut frame = Vec::new();
    let mut mask = Vec::new();
    for chunk in server.imagine(request).await.unwrap() {
        let from = chunk.first_candidate;
        if chunk.depths != [3] || !(from..from + chunk.candidates).contains(&2) {
            continue;
        }
        for (value, to) in chunk.outputs.iter().zip([&mut frame, &mut mask]) {
            let Some(Value::Tensor(tensor)) = &value.value else { panic!("pictures are tensors") };
            let bytes = tensor.data.len() / chunk.candidates as usize;
            *to = tensor.data[(2 - from) as usize * bytes..][..bytes].to_vec();
        }
    }
    let masks = v1::MaskGoal {
        part: v1::MaskPart::Agent.into(),
        masks: Some(v1::Tensor {
            dtype: v1::DataType::U8.into(),
            shape: vec![64, 64],
            data: mask.into(),
            values: vec![],
        }),
        object_ids: vec![],
    };
    let request = v1::PutGoalRequest {
        image: Some(u8_image(64, 64, frame)),
        masks: vec![masks.clone()],
        ..Default::default()
    };
    let goal = planning.put_goal(request).await.unwrap().into_inner().goal.unwrap();
    assert!(goal.has_image && goal.parts == [v1::MaskPart::Agent as i32], "{goal:?}");
    let last = |measure| v1::CostTerm { when: v1::When::LastStep.into(), ..term(measure) };
    let image = |pixels: v1::Pixels| {
        last(Measure::GoalImage(v1::GoalImage { goal_id: goal.id.clone(), pixels: pixels.into() }))
    };
    let agent_mask = last(Measure::GoalMasks(v1::GoalMasks {
        goal_id: goal.id.clone(),
        part: v1::MaskPart::Agent.into(),
    }));
    for term in [
        image(v1::Pixels::All),
        image(v1::Pixels::Agent),
        image(v1::Pixels::Background),
        agent_mask.clone(),
    ] {
        let answer = planning.score(score(&session, vec![term])).await.unwrap().into_inner();
        let found = floats(&answer.costs.unwrap());
        assert!(answer.best == 2 && found[2] < 1e-6 && found[0] > found[2], "{found:?}");
    }

    let refused = async |request: v1::PutGoalRequest| {
        field(&server.planning.clone().put_goal(request).await.unwrap_err())
    };
    assert_eq!(refused(v1::PutGoalRequest::default()).await, "image");
    let flat = v1::MaskGoal { part: v1::MaskPart::EachObject.into(), ..masks };
    let flat = v1::PutGoalRequest { masks: vec![flat], ..Default::default() };
    assert_eq!(refused(flat).await, "masks[0].masks.shape");
    let objects = last(Measure::GoalMasks(v1::GoalMasks { goal_id: goal.id.clone(), part: 0 }));
    let status = planning.score(score(&session, vec![objects])).await.unwrap_err();
    assert_eq!(field(&status), "costs.terms[0].goal_masks.goal_id");

    let path = format!("/v1/goals/{}", goal.id);
    assert_eq!(server.delete(&path).send().await.unwrap().status(), 200);
    assert_eq!(server.delete(&path).send().await.unwrap().status(), 404);
    let status = planning.score(score(&session, vec![agent_mask])).await.unwrap_err();
    assert_eq!((status.code(), status.message().contains(&goal.id)), (Code::NotFound, true));
    server.app.shutdown().await;
}
