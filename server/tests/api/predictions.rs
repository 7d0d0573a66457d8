//! Predictions in bulk: each as it would be alone, whatever it starts from.

use std::collections::BTreeMap;

use base64::{Engine as _, prelude::BASE64_STANDARD};
use gatsbi_proto::v1::{self, Encoding, Output, predict_batch_response::Result, start::From};
use serde_json::{Value as Json, json};
use tokio_stream::iter;
use tonic::Code;

use crate::support::{
    ACTION, TestServer, actions, f32_tensor, named, observation, outputs, picture, rollout, tensor,
};

/// Rows of frames by candidate and depth.
type Frames = BTreeMap<(u32, u32), Vec<u8>>;

fn add(frames: &mut Frames, chunk: &v1::RolloutChunk) {
    let frame = tensor(&chunk.outputs, Output::Frame);
    let row = frame.data.len() / chunk.candidates as usize;
    for (at, row) in frame.data.chunks_exact(row).enumerate() {
        let key = (chunk.first_candidate + at as u32, chunk.depths[0]);
        assert!(frames.insert(key, row.to_vec()).is_none());
    }
}

/// Three candidates over two steps, drawn with some seed.
fn request(key: u64, from: Option<From>, seed: u64) -> v1::PredictBatchRequest {
    v1::PredictBatchRequest {
        key,
        start: Some(v1::Start { from }),
        actions: Some(f32_tensor(&[3, 2, ACTION as u32], &actions(3, 2, 3))),
        sampling: Some(v1::Sampling { seed: Some(seed), ..Default::default() }),
        outputs: None,
        costs: None,
    }
}

fn frames_asked() -> v1::OutputSelection {
    outputs(&[Output::Frame], Encoding::U8)
}

/// The frames and actions that the made-up observations of a session with a seed have.
fn context(seed: u64, steps: u64) -> v1::Context {
    let frames: Vec<u8> = (0..steps).flat_map(|step| picture(seed, step)).collect();
    let taken: Vec<f32> = (0..steps).flat_map(|step| actions(1, 1, step)).collect();
    v1::Context {
        model: String::new(),
        frames: Some(v1::Tensor {
            dtype: v1::DataType::U8.into(),
            shape: vec![steps as u32, 64, 64, 3],
            data: frames.into(),
            values: Vec::new(),
        }),
        actions: Some(f32_tensor(&[steps as u32, ACTION as u32], &taken)),
        seed: Some(seed),
    }
}

async fn predict(
    server: &TestServer,
    requests: Vec<v1::PredictBatchRequest>,
) -> (BTreeMap<u64, Frames>, BTreeMap<u64, v1::Problem>) {
    let (mut frames, mut problems, mut last) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
    let answers = server.imagination.clone().predict_batch(iter(requests)).await.unwrap();
    let mut answers = answers.into_inner();
    while let Some(answer) = answers.message().await.unwrap() {
        match answer.result.unwrap() {
            Result::Chunk(chunk) => {
                add(frames.entry(answer.key).or_default(), &chunk);
                let before = last.insert(answer.key, chunk.last);
                assert_ne!(before, Some(true), "a chunk after the last one");
            }
            Result::Problem(problem) => {
                assert!(problems.insert(answer.key, problem).is_none());
            }
        }
    }
    assert!(last.values().all(|last| *last));
    (frames, problems)
}

#[tokio::test]
async fn every_start_gives_what_a_session_would() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 2).await;
    let export = v1::ExportSessionRequest { session_id: session.id.clone(), at_step: None };
    let export = server.sessions.clone().export_session(export).await.unwrap().into_inner();
    let mut expected = Frames::new();
    let mut alone = rollout(&session, 3, 2);
    alone.sampling.as_mut().unwrap().seed = Some(21);
    for chunk in server.imagine(alone).await.unwrap() {
        add(&mut expected, &chunk);
    }
    let from_session =
        From::Session(v1::SessionStart { session_id: session.id.clone(), at_step: Some(1) });
    let mut first = request(1, Some(from_session.clone()), 21);
    first.outputs = Some(frames_asked());
    let mut requests = vec![first];
    requests.push(request(2, Some(From::Snapshot(export.snapshot)), 21));
    requests.push(request(3, Some(From::Context(context(4, 2))), 21));
    // Many more, so that they wait for each other.
    for key in 10..50 {
        requests.push(request(key, Some(from_session.clone()), 21 + key));
    }
    let (frames, problems) = predict(&server, requests).await;
    assert_eq!((frames.len(), problems.len()), (43, 0));
    for key in 1..4 {
        assert_eq!(frames[&key], expected, "start {key}");
    }
    assert_ne!(frames[&10], frames[&11], "seeds matter");
    assert_eq!(server.next_step(&session).await, 2);

    // Without an action to the first frame, the neutral one leads there.
    let mut context = context(4, 2);
    let second = actions(1, 1, 1);
    context.actions = Some(f32_tensor(&[1, ACTION as u32], &second));
    let neutral = server.session(4).await;
    let mut observed = observation(&neutral, 0);
    observed.observation.as_mut().unwrap().action.clear();
    server.observe(observed).await.unwrap();
    server.observe(observation(&neutral, 1)).await.unwrap();
    let from = From::Session(v1::SessionStart { session_id: neutral.id, at_step: None });
    let mut requests = vec![request(1, Some(from), 5), request(2, Some(From::Context(context)), 5)];
    requests[0].outputs = Some(frames_asked());
    let (frames, _) = predict(&server, requests).await;
    assert_eq!(frames[&1], frames[&2]);
    server.app.shutdown().await;
}

#[tokio::test]
async fn what_is_wrong_with_one_does_not_touch_the_others() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 1).await;
    let good = From::Session(v1::SessionStart { session_id: session.id.clone(), at_step: None });
    let unknown = From::Session(v1::SessionStart { session_id: "0".repeat(32), at_step: None });
    let moved = From::Session(v1::SessionStart { session_id: session.id, at_step: Some(7) });
    let broken = From::Snapshot(b"gatsbi".as_slice().into());
    let with = |spoil: fn(&mut v1::Context)| {
        let mut context = context(4, 2);
        spoil(&mut context);
        From::Context(context)
    };
    let mut requests = vec![request(0, Some(good.clone()), 3)];
    requests[0].outputs = Some(frames_asked());
    let mut no_actions = request(9, Some(good.clone()), 3);
    no_actions.actions = None;
    for (key, from) in [
        (1, None),
        (2, Some(unknown)),
        (3, Some(moved)),
        (4, Some(broken)),
        (5, Some(with(|context| context.frames = None))),
        (6, Some(with(|context| context.actions.as_mut().unwrap().shape[0] = 5))),
        (7, Some(with(|context| context.model = "huge".to_owned()))),
        (8, Some(with(|context| context.frames.as_mut().unwrap().shape[0] = 3))),
    ] {
        requests.push(request(key, from, 3));
    }
    requests.push(no_actions);
    requests.push(request(10, Some(good), 3));
    let (frames, problems) = predict(&server, requests).await;
    assert_eq!(frames.keys().copied().collect::<Vec<_>>(), [0, 10]);
    assert_eq!(frames[&0], frames[&10]);
    for (key, reason, field) in [
        (1, "INVALID_FIELDS", "start"),
        (2, "UNKNOWN_SESSION", "session_id"),
        (3, "SESSION_MOVED", "at_step"),
        (4, "INVALID_FIELDS", "start.snapshot"),
        (5, "INVALID_FIELDS", "start.context.frames.shape"),
        (6, "INVALID_FIELDS", "start.context.actions.shape"),
        (7, "UNKNOWN_MODEL", "model"),
        (8, "INVALID_FIELDS", "start.context.frames.data"),
        (9, "INVALID_FIELDS", "actions"),
    ] {
        let problem = &problems[&key];
        assert_eq!((problem.reason.as_str(), problem.fields[0].field.as_str()), (reason, field));
    }
    assert_eq!(problems.len(), 9);
    server.app.shutdown().await;
}

#[tokio::test]
async fn rest_takes_a_prediction_a_line() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 1).await;
    let line = |key: u64, outputs: bool| {
        let mut line = json!({
            "key": key,
            "start": { "session": { "session_id": session.id } },
            "actions": {
                "dtype": "DATA_TYPE_F32", "shape": [3, 2, ACTION], "values": actions(3, 2, 3),
            },
            "sampling": { "seed": 11 },
        });
        if outputs {
            line["outputs"] = json!({ "outputs": ["OUTPUT_FRAME"], "encoding": "ENCODING_U8", "last_only": true });
        }
        line
    };
    let mut expected = Frames::new();
    for chunk in server.imagine(rollout(&session, 3, 2)).await.unwrap() {
        add(&mut expected, &chunk);
    }
    let body = format!("{}\n\n{}\n", line(7, true), line(8, false));
    let lines = "application/x-ndjson";
    let post = |media: &'static str, body: String| {
        server.post("/v1/predictions").header("content-type", media).body(body).send()
    };
    let answer = post(lines, body).await.unwrap();
    assert_eq!(answer.headers()["content-type"], lines);
    let text = answer.text().await.unwrap();
    let mut rows = 0;
    for answer in text.lines().map(|line| serde_json::from_str::<Json>(line).unwrap()) {
        assert!([7, 8].contains(&answer["key"].as_u64().unwrap()));
        let chunk = &answer["chunk"];
        assert_eq!(chunk["depths"], json!([2]));
        let data = chunk["outputs"][0]["tensor"]["data"].as_str().unwrap();
        let data = BASE64_STANDARD.decode(data).unwrap();
        for (at, frame) in data.chunks_exact(64 * 64 * 3).enumerate() {
            let first = chunk["first_candidate"].as_u64().unwrap() as u32;
            assert_eq!(expected[&(first + at as u32, 2)], frame);
            rows += 1;
        }
    }
    assert_eq!(rows, 6);
    let single = post("application/json", line(9, true).to_string()).await.unwrap();
    assert!(single.text().await.unwrap().lines().all(|line| line.contains("\"key\":9")));
    let wrong = post(lines, format!("{}\n{{\"keyy\": 3}}\n", line(7, true))).await.unwrap();
    assert_eq!(wrong.status(), 400);
    server.app.shutdown().await;
}

#[tokio::test]
async fn live_work_goes_before_a_batch_and_a_batch_that_is_left_ends() {
    let server = TestServer::with(named("batch")).await;
    let session = server.seasoned(4, 1).await;
    let mut first = request(0, Some(From::Context(context(4, 2))), 0);
    first.outputs = Some(frames_asked());
    let (sending, requests) = tokio::sync::mpsc::channel(100);
    sending.send(first).await.unwrap();
    for key in 1..80 {
        let request = request(key, Some(From::Context(context(key, 2))), key);
        sending.send(request).await.unwrap();
    }
    let requests = tokio_stream::wrappers::ReceiverStream::new(requests);
    let answers = server.imagination.clone().predict_batch(requests).await.unwrap();
    let mut answers = answers.into_inner();
    answers.message().await.unwrap().unwrap();
    let began = std::time::Instant::now();
    for step in 1..6 {
        server.observe(observation(&session, step)).await.unwrap();
    }
    server.imagine(rollout(&session, 2, 2)).await.unwrap();
    let live = began.elapsed();
    assert!(live.as_secs() < 10, "{live:?}");
    drop((answers, sending));
    let began = std::time::Instant::now();
    while server.metric("gatsbi_given_up_total{model=\"batch\"}").await < 1.0 {
        assert!(began.elapsed().as_secs() < 20);
        server.observe(observation(&session, server.next_step(&session).await)).await.unwrap();
    }
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_batch_without_a_start_says_so() {
    let server = TestServer::start().await;
    let (frames, problems) = predict(&server, vec![v1::PredictBatchRequest::default()]).await;
    assert!(frames.is_empty());
    assert_eq!(problems[&0].code, Code::InvalidArgument as i32);
    server.app.shutdown().await;
}
