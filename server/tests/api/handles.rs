//! Handles: stepped one action at a time, rows are where a rollout with the same actions would be.

use gatsbi_proto::v1::{self, Encoding, Output, start::From};
use tonic::{Code, Status};
use tonic_types::StatusExt as _;

use crate::support::{ACTION, TestServer, actions, f32_tensor, floats, outputs, rollout, tensor};

fn start(session: &v1::Session) -> v1::Start {
    let session = v1::SessionStart { session_id: session.id.clone(), at_step: None };
    v1::Start { from: Some(From::Session(session)) }
}

async fn open(
    server: &TestServer,
    starts: Vec<v1::Start>,
    sampling: v1::Sampling,
) -> Result<v1::OpenHandlesResponse, Status> {
    let request = v1::OpenHandlesRequest { starts, sampling: Some(sampling), ttl: None };
    Ok(server.imagination.clone().open_handles(request).await?.into_inner())
}

async fn step(
    server: &TestServer,
    request: v1::StepHandlesRequest,
) -> Result<v1::StepHandlesResponse, Status> {
    Ok(server.imagination.clone().step_handles(request).await?.into_inner())
}

/// A step of all rows with the made-up actions of candidates at a depth, as [`rollout`] has them.
fn request(handles: &v1::OpenHandlesResponse, depth: usize) -> v1::StepHandlesRequest {
    let (rows, horizon) = (handles.rows as usize, 3);
    let all = actions(rows, horizon, 3);
    let at = |row: usize| &all[(row * horizon + depth) * ACTION..][..ACTION];
    let taken: Vec<f32> = (0..rows).flat_map(at).copied().collect();
    v1::StepHandlesRequest {
        handles_id: handles.handles_id.clone(),
        actions: Some(f32_tensor(&[rows as u32, ACTION as u32], &taken)),
        outputs: Some(outputs(&[Output::Frame, Output::Objects], Encoding::U8)),
        ..Default::default()
    }
}

/// Frames of rows.
fn frames(answer: &v1::StepHandlesResponse) -> Vec<Vec<u8>> {
    let frame = tensor(&answer.outputs, Output::Frame);
    assert_eq!(frame.shape[1..], [64, 64, 3]);
    frame.data.chunks_exact(64 * 64 * 3).map(<[u8]>::to_vec).collect()
}

#[tokio::test]
async fn stepped_rows_are_where_a_rollout_would_be() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 2).await;
    let sampling = v1::Sampling { seed: Some(11), ..Default::default() };
    let handles = open(&server, vec![start(&session); 5], sampling).await.unwrap();
    assert_eq!((handles.rows, handles.seed, handles.model_hash.len()), (5, 11, 64));
    let mut expected = vec![vec![Vec::new(); 3]; 5];
    for chunk in server.imagine(rollout(&session, 5, 3)).await.unwrap() {
        let data = &tensor(&chunk.outputs, Output::Frame).data;
        for (at, frame) in data.chunks_exact(64 * 64 * 3).enumerate() {
            expected[chunk.first_candidate as usize + at][chunk.depths[0] as usize - 1] =
                frame.to_vec();
        }
    }
    for depth in 0..3 {
        let answer = step(&server, request(&handles, depth)).await.unwrap();
        assert_eq!(answer.step, depth as u64 + 1);
        let Some(v1::output_value::Value::Tracks(tracks)) = &answer.outputs[1].value else {
            panic!("objects come as tracks")
        };
        assert_eq!(tracks.values.as_ref().unwrap().shape, [5, 7, 6]);
        for (row, (frame, expected)) in frames(&answer).iter().zip(&expected).enumerate() {
            assert!(*frame == expected[depth], "row {row} at depth {depth}");
        }
    }

    // Some go back and take their first step again while others go on.
    let mut again = request(&handles, 0);
    again.rows = vec![3, 1];
    again.restart = vec![1];
    let first = actions(5, 3, 3);
    let taken = [&first[9 * ACTION..][..ACTION], &first[3 * ACTION..][..ACTION]].concat();
    again.actions = Some(f32_tensor(&[2, ACTION as u32], &taken));
    let answer = step(&server, again).await.unwrap();
    let rows = frames(&answer);
    assert_eq!((answer.step, rows.len()), (4, 2));
    assert!(rows[1] == expected[1][0], "it is where it was after its first step");
    assert!(rows[0] != expected[3][0], "it went on");
    assert_eq!(server.next_step(&session).await, 2);
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_lost_answer_is_given_again_and_a_failed_step_moves_nothing() {
    type Spoil = fn(&mut v1::StepHandlesRequest);
    let server = TestServer::start().await;
    let session = server.seasoned(4, 1).await;
    let sampling = v1::Sampling { seed: Some(2), samples: Some(2), ..Default::default() };
    let handles = open(&server, vec![start(&session)], sampling).await.unwrap();
    assert_eq!(handles.rows, 2);
    let mut first = request(&handles, 0);
    first.step = Some(0);
    // Both take the same action; they draw apart.
    let action = actions(1, 1, 3);
    first.actions = Some(f32_tensor(&[2, ACTION as u32], &[action.clone(), action].concat()));
    first.outputs = Some(outputs(&[Output::Latents], Encoding::F32));
    let answer = step(&server, first.clone()).await.unwrap();
    let latents = floats(tensor(&answer.outputs, Output::Latents));
    let (one, other) = latents.split_at(latents.len() / 2);
    assert!(one.iter().zip(other).any(|(a, b)| (a - b).abs() > 1e-3));
    assert_eq!(step(&server, first.clone()).await.unwrap(), answer);

    let reason = |status: &Status| status.get_error_details().error_info().unwrap().reason.clone();
    let mut other = first.clone();
    other.restart = vec![0];
    let status = step(&server, other).await.unwrap_err();
    assert_eq!(reason(&status), "HANDLES_MOVED", "stepped otherwise");
    let status = step(&server, v1::StepHandlesRequest { step: Some(5), ..first.clone() }).await;
    assert_eq!(reason(&status.unwrap_err()), "HANDLES_MOVED");
    let cases: [(&str, Spoil); 6] = [
        ("rows[1]", |r| r.rows = vec![0, 0]),
        ("rows[0]", |r| r.rows = vec![2]),
        ("restart[0]", |r| r.restart = vec![7]),
        ("actions.shape", |r| r.rows = vec![1]),
        ("actions", |r| r.actions = None),
        ("outputs.last_only", |r| r.outputs.as_mut().unwrap().last_only = true),
    ];
    for (field, spoil) in cases {
        let mut request = v1::StepHandlesRequest { step: Some(1), ..first.clone() };
        spoil(&mut request);
        let status = step(&server, request).await.unwrap_err();
        assert_eq!(status.code(), Code::InvalidArgument, "{field}");
        let details = status.get_error_details();
        assert_eq!(details.bad_request().unwrap().field_violations[0].field, field);
    }
    let mut hopeless = v1::StepHandlesRequest { step: Some(1), ..first.clone() };
    hopeless.outputs = Some(outputs(&[Output::Surprise], Encoding::F32));
    assert_eq!(reason(&step(&server, hopeless).await.unwrap_err()), "OUTPUT_UNAVAILABLE");
    let next = v1::StepHandlesRequest { step: Some(1), ..first };
    assert_eq!(step(&server, next).await.unwrap().step, 2);
    server.app.shutdown().await;
}

#[tokio::test]
async fn handles_are_closed_or_expire() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 1).await;
    let handles = open(&server, vec![start(&session)], v1::Sampling::default()).await.unwrap();
    let close = v1::CloseHandlesRequest { handles_id: handles.handles_id.clone() };
    server.imagination.clone().close_handles(close.clone()).await.unwrap();
    let gone = server.imagination.clone().close_handles(close).await.unwrap_err();
    assert_eq!(gone.code(), Code::NotFound);
    let gone = step(&server, request(&handles, 0)).await.unwrap_err();
    assert_eq!(gone.code(), Code::NotFound);
    let ttl = Some(prost_types::Duration { seconds: 0, nanos: 1 });
    let brief = v1::OpenHandlesRequest { starts: vec![start(&session)], ttl, sampling: None };
    let brief = server.imagination.clone().open_handles(brief).await.unwrap().into_inner();
    let gone = step(&server, request(&brief, 0)).await.unwrap_err();
    assert_eq!(gone.code(), Code::NotFound);
    let none = open(&server, Vec::new(), v1::Sampling::default()).await.unwrap_err();
    assert_eq!(none.code(), Code::InvalidArgument);
    server.app.shutdown().await;
}
