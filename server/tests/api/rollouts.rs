//! Rollouts: complete, self-describing, fair between candidates, and without a trace in the session.

use std::collections::BTreeMap;

use base64::{Engine as _, prelude::BASE64_STANDARD};
use gatsbi_proto::v1::{self, Encoding, Mode, Output};
use serde_json::{Value as Json, json};

use crate::support::{
    ACTION, TestServer, actions, f32_tensor, floats, observation, outputs, rollout, tensor,
};

/// Bytes of each row's frame by (sample, candidate, depth).
type Frames = BTreeMap<(u32, u32, u32), Vec<u8>>;

fn frames(chunks: &[v1::RolloutChunk]) -> Frames {
    let mut frames = Frames::new();
    for chunk in chunks {
        let frame = tensor(&chunk.outputs, Output::Frame);
        let leading = [chunk.candidates, chunk.depths.len() as u32];
        assert_eq!(frame.shape[..2], leading);
        let row = frame.data.len() / leading.iter().product::<u32>() as usize;
        let mut rows = frame.data.chunks_exact(row);
        for candidate in chunk.first_candidate..chunk.first_candidate + chunk.candidates {
            for depth in &chunk.depths {
                let row = rows.next().unwrap().to_vec();
                let old = frames.insert((chunk.sample, candidate, *depth), row);
                assert!(old.is_none(), "a row came twice");
            }
        }
    }
    frames
}

fn keys(samples: u32, candidates: u32, depths: &[u32]) -> Vec<(u32, u32, u32)> {
    let mut keys = Vec::new();
    for sample in 0..samples {
        for candidate in 0..candidates {
            keys.extend(depths.iter().map(|depth| (sample, candidate, *depth)));
        }
    }
    keys
}

#[tokio::test]
async fn a_rollout_is_complete_and_describes_itself() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 2).await;
    let mut request = rollout(&session, 5, 4);
    request.at_step = Some(1);
    request.sampling.as_mut().unwrap().samples = Some(2);
    let wanted = [Output::Frame, Output::Objects, Output::AgentMask];
    request.outputs = Some(outputs(&wanted, Encoding::U8));
    let chunks = server.imagine(request).await.unwrap();
    assert!(frames(&chunks).into_keys().eq(keys(2, 5, &[1, 2, 3, 4])));
    let mut depths = BTreeMap::new();
    for (at, chunk) in chunks.iter().enumerate() {
        assert_eq!((chunk.at_step, chunk.seed), (1, 11));
        assert_eq!(chunk.model_hash, session.model_hash);
        assert_eq!(chunk.last, at + 1 == chunks.len());
        assert!(chunk.timing.unwrap().compute_micros > 0);
        assert_eq!(chunk.outputs.len(), 3);
        let before = depths.insert((chunk.sample, chunk.first_candidate), chunk.depths[0]);
        assert!(before < Some(chunk.depths[0]), "a candidate's depths ascend");
        let objects = chunk.outputs.iter().find(|value| value.output() == Output::Objects);
        let Some(v1::output_value::Value::Tracks(tracks)) = &objects.unwrap().value else {
            panic!("objects come as tracks")
        };
        assert_eq!(tracks.ids.as_ref().unwrap().shape, [chunk.candidates, 1, 7]);
        assert_eq!(tracks.values.as_ref().unwrap().shape, [chunk.candidates, 1, 7, 6]);
    }
    server.app.shutdown().await;
}

#[tokio::test]
async fn only_the_steps_that_were_asked_for_come() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 1).await;
    let all = frames(&server.imagine(rollout(&session, 3, 5)).await.unwrap());
    for (every_k, last_only, depths) in
        [(Some(2), false, vec![2, 4]), (None, true, vec![5]), (Some(5), false, vec![5])]
    {
        let mut request = rollout(&session, 3, 5);
        let selection = request.outputs.as_mut().unwrap();
        (selection.every_k, selection.last_only) = (every_k, last_only);
        let some = frames(&server.imagine(request).await.unwrap());
        assert!(some.keys().copied().eq(keys(1, 3, &depths)), "{every_k:?} {last_only}");
        assert!(some.iter().all(|(key, frame)| all[key] == *frame));
    }
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_session_does_not_notice_rollouts() {
    let server = TestServer::start().await;
    let (with, without) = (server.seasoned(4, 2).await, server.seasoned(4, 2).await);
    server.imagine(rollout(&with, 3, 3)).await.unwrap();
    let mut plain = observation(&with, 2);
    plain.session_id = without.id.clone();
    let expected = server.observe(plain).await.unwrap();
    let belief = server.observe(observation(&with, 2)).await.unwrap();
    assert_eq!((belief.outputs, belief.objects), (expected.outputs, expected.objects));
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_rollout_pins_the_belief_that_it_starts_from() {
    let server = TestServer::start().await;
    let (session, moving) = (server.seasoned(4, 2).await, server.seasoned(4, 2).await);
    let expected = frames(&server.imagine(rollout(&session, 2, 8)).await.unwrap());
    let mut request = rollout(&session, 2, 8);
    request.session_id = moving.id.clone();
    let mut answers = server.imagination.clone().imagine(request).await.unwrap().into_inner();
    let mut chunks = vec![answers.message().await.unwrap().unwrap().chunk.unwrap()];
    server.observe(observation(&moving, 2)).await.unwrap();
    while let Some(answer) = answers.message().await.unwrap() {
        chunks.push(answer.chunk.unwrap());
    }
    assert_eq!(frames(&chunks), expected);
    server.app.shutdown().await;
}

#[tokio::test]
async fn candidates_are_compared_fairly_unless_told_otherwise() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 1).await;
    let twice = {
        let one = actions(1, 2, 3);
        f32_tensor(&[2, 2, ACTION as u32], &[one.clone(), one].concat())
    };
    let run = async |seed: u64, independent: bool, mode: Mode| {
        let mut request = rollout(&session, 2, 2);
        request.actions = Some(twice.clone());
        request.sampling = Some(v1::Sampling {
            mode: mode.into(),
            seed: (mode == Mode::Sample).then_some(seed),
            samples: (mode == Mode::Sample).then_some(2),
            independent_candidates: independent,
        });
        frames(&server.imagine(request).await.unwrap())
    };
    let shared = run(8, false, Mode::Sample).await;
    let close = |a: &[u8], b: &[u8]| a.iter().zip(b).all(|(a, b)| a.abs_diff(*b) <= 1);
    // Equal actions and equal noise; lanes may differ in the last bit.
    assert!(close(&shared[&(0, 0, 2)], &shared[&(0, 1, 2)]));
    assert!(!close(&shared[&(0, 0, 2)], &shared[&(1, 0, 2)]), "samples differ");
    let apart = run(8, true, Mode::Sample).await;
    assert!(!close(&apart[&(0, 0, 2)], &apart[&(0, 1, 2)]));
    assert_eq!(apart[&(0, 0, 2)], shared[&(0, 0, 2)], "the first draws as before");
    assert_eq!(run(8, false, Mode::Sample).await, shared, "equal requests, equal answers");
    let other = run(16, false, Mode::Sample).await;
    assert!(!close(&other[&(0, 0, 2)], &shared[&(0, 0, 2)]), "seeds matter");
    let mean = run(0, false, Mode::Mean).await;
    assert_eq!(mean.len(), 4);
    assert!(close(&mean[&(0, 0, 2)], &mean[&(0, 1, 2)]));
    server.app.shutdown().await;
}

#[tokio::test]
async fn rest_gives_the_same_chunks_by_line_or_at_once() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 1).await;
    let expected = frames(&server.imagine(rollout(&session, 2, 3)).await.unwrap());
    let body = json!({
        "actions": {
            "dtype": "DATA_TYPE_F32", "shape": [2, 3, ACTION], "values": actions(2, 3, 3),
        },
        "sampling": { "seed": 11 },
        "outputs": { "outputs": ["OUTPUT_FRAME"], "encoding": "ENCODING_U8" },
    });
    let path = format!("/v1/sessions/{}/rollouts", session.id);
    let response = server.post(&path).json(&body).send().await.unwrap();
    assert_eq!(response.headers()["content-type"], "application/x-ndjson");
    let text = response.text().await.unwrap();
    let by_line: Vec<Json> = text
        .lines()
        .map(|line| serde_json::from_str::<Json>(line).unwrap()["chunk"].take())
        .collect();
    let whole = server.post(&path).json(&body).header("accept", "application/json").send().await;
    let whole: Json = whole.unwrap().json().await.unwrap();
    let whole: Vec<Json> = whole["chunks"].as_array().unwrap().clone();
    for chunks in [by_line, whole] {
        let mut rows = 0;
        for chunk in &chunks {
            let data = chunk["outputs"][0]["tensor"]["data"].as_str().unwrap();
            let data = BASE64_STANDARD.decode(data).unwrap();
            for (at, frame) in data.chunks_exact(64 * 64 * 3).enumerate() {
                let number = |name: &str| chunk[name].as_u64().unwrap() as u32;
                let depth = chunk["depths"][0].as_u64().unwrap() as u32;
                let key = (number("sample"), number("first_candidate") + at as u32, depth);
                assert_eq!(expected[&key], frame);
                rows += 1;
            }
        }
        assert_eq!(rows, expected.len());
        assert_eq!(chunks.last().unwrap()["last"], true);
    }
    server.app.shutdown().await;
}

#[tokio::test]
async fn spread_is_how_far_samples_disagree() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 1).await;
    let mut request = rollout(&session, 3, 2);
    request.sampling.as_mut().unwrap().samples = Some(4);
    let wanted = [Output::Frame, Output::Objects, Output::Spread, Output::ObjectSpread];
    request.outputs = Some(outputs(&wanted, Encoding::F32));
    let chunks = server.imagine(request.clone()).await.unwrap();
    let mut samples: BTreeMap<(u32, u32), Vec<Vec<f32>>> = BTreeMap::new();
    let mut places: BTreeMap<(u32, u32), Vec<Vec<f32>>> = BTreeMap::new();
    for chunk in chunks.iter().filter(|chunk| !chunk.over_samples) {
        assert_eq!(chunk.outputs.len(), 2);
        let frames = floats(tensor(&chunk.outputs, Output::Frame));
        let tracks = chunk.outputs.iter().find_map(|value| match &value.value {
            Some(v1::output_value::Value::Tracks(tracks)) => tracks.values.as_ref(),
            _ => None,
        });
        let tracks = floats(tracks.unwrap());
        for at in 0..chunk.candidates as usize {
            let key = (chunk.first_candidate + at as u32, chunk.depths[0]);
            samples.entry(key).or_default().push(frames[at * 12_288..][..12_288].to_vec());
            let objects = tracks[at * 42..][..42].chunks_exact(6);
            places.entry(key).or_default().push(objects.flat_map(|o| o[1..3].to_vec()).collect());
        }
    }
    let deviations = |rows: &[Vec<f32>]| -> Vec<f32> {
        let count = rows.len() as f32;
        (0..rows[0].len())
            .map(|at| {
                let mean = rows.iter().map(|row| row[at]).sum::<f32>() / count;
                (rows.iter().map(|row| (row[at] - mean).powi(2)).sum::<f32>() / count).sqrt()
            })
            .collect()
    };
    let spread: Vec<&v1::RolloutChunk> = chunks.iter().filter(|chunk| chunk.over_samples).collect();
    assert_eq!(spread.len(), 6, "three candidates at two depths");
    for chunk in &spread {
        let key = (chunk.first_candidate, chunk.depths[0]);
        let map = tensor(&chunk.outputs, Output::Spread);
        assert_eq!(map.shape, [1, 1, 64, 64]);
        let colours = deviations(&samples[&key]);
        let expected = colours.chunks_exact(3).map(|colour| colour.iter().sum::<f32>() / 3.0);
        assert!(floats(map).iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-4));
        let objects = tensor(&chunk.outputs, Output::ObjectSpread);
        assert_eq!(objects.shape, [1, 1, 7, 2]);
        let expected = deviations(&places[&key]);
        assert!(floats(objects).iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-4));
    }
    assert!(floats(tensor(&spread[0].outputs, Output::Spread)).iter().any(|x| *x > 1e-3));
    assert_eq!(chunks.iter().filter(|chunk| chunk.last).count(), 1);
    assert!(chunks.last().unwrap().last);

    // Alone it is the same, and nothing else comes.
    request.outputs = Some(outputs(&[Output::Spread], Encoding::U8));
    let alone = server.imagine(request.clone()).await.unwrap();
    assert!(alone.len() == 6 && alone.last().unwrap().last);
    for chunk in &alone {
        let twin = spread.iter().find(|other| {
            (other.first_candidate, &other.depths) == (chunk.first_candidate, &chunk.depths)
        });
        assert_eq!(chunk.outputs, twin.unwrap().outputs[..1]);
    }
    request.sampling.as_mut().unwrap().samples = None;
    let status = server.imagine(request).await.unwrap_err();
    assert_eq!(status.code(), tonic::Code::FailedPrecondition);
    server.app.shutdown().await;
}
