//! Forks and returns to earlier steps: the same observations have the same bytes as without them.

use gatsbi_proto::v1;
use gatsbi_server::config::Config;
use serde_json::json;
use tonic::{Code, Status};
use tonic_types::StatusExt as _;

use crate::support::{TestServer, config, observation, rollout};

/// A session that keeps steps and has observed some.
async fn keeping(server: &TestServer, keep_steps: u32, steps: u64) -> v1::Session {
    let request = v1::CreateSessionRequest { seed: Some(4), keep_steps, ..Default::default() };
    let session = server.sessions.clone().create_session(request).await.unwrap();
    let session = session.into_inner().session.unwrap();
    for step in 0..steps {
        server.observe(observation(&session, step)).await.unwrap();
    }
    session
}

async fn fork(
    server: &TestServer,
    request: v1::ForkSessionRequest,
) -> Result<Vec<v1::Session>, Status> {
    Ok(server.sessions.clone().fork_session(request).await?.into_inner().sessions)
}

async fn rewind(
    server: &TestServer,
    session: &v1::Session,
    to_step: Option<u64>,
) -> Result<v1::Session, Status> {
    let request = v1::RewindSessionRequest { session_id: session.id.clone(), to_step };
    let answer = server.sessions.clone().rewind_session(request).await?;
    Ok(answer.into_inner().session.unwrap())
}

/// What a belief says, whichever session's it is.
async fn seen(server: &TestServer, session: &v1::Session, step: u64) -> v1::Belief {
    let mut request = observation(session, step);
    // The made-up picture is that of the original's seed.
    request.observation.as_mut().unwrap().image = Some(picture(4, step));
    let belief = server.observe(request).await.unwrap();
    v1::Belief { session_id: String::new(), timing: None, ..belief }
}

fn picture(seed: u64, step: u64) -> v1::Image {
    crate::support::u8_image(64, 64, crate::support::picture(seed, step))
}

#[tokio::test]
async fn forks_go_on_as_the_original_does() {
    let server = TestServer::start().await;
    let session = keeping(&server, 2, 3).await;
    let request = v1::ForkSessionRequest {
        session_id: session.id.clone(),
        at_step: Some(2),
        count: Some(2),
        label: Some("what if".to_owned()),
        ..Default::default()
    };
    let forks = fork(&server, request.clone()).await.unwrap();
    assert_eq!(forks.len(), 2);
    for fork in &forks {
        assert_eq!((fork.next_step, fork.seed, fork.label.as_str()), (3, 4, "what if"));
        assert_eq!((fork.keep_steps, fork.oldest_step), (2, Some(0)));
        assert!(fork.id != session.id);
    }
    let original = [seen(&server, &session, 3).await, seen(&server, &session, 4).await];
    for fork in &forks {
        let forked = [seen(&server, fork, 3).await, seen(&server, fork, 4).await];
        assert_eq!(forked, original);
        let outputs = |chunks: Vec<v1::RolloutChunk>| {
            chunks.into_iter().map(|chunk| chunk.outputs).collect::<Vec<_>>()
        };
        let imagined = outputs(server.imagine(rollout(fork, 2, 2)).await.unwrap());
        assert_eq!(imagined, outputs(server.imagine(rollout(&session, 2, 2)).await.unwrap()));
    }

    // They go their own ways, and one with another seed does so at once.
    let request = v1::ForkSessionRequest { at_step: None, seed: Some(5), ..request };
    let other = fork(&server, request).await.unwrap().remove(0);
    assert_eq!((other.seed, other.next_step), (5, 5));
    let elsewhere = seen(&server, &other, 5).await;
    assert_ne!(elsewhere, seen(&server, &session, 5).await);
    assert_eq!(server.next_step(&forks[0]).await, 5);
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_rewound_session_sees_again_what_it_saw() {
    let server = TestServer::start().await;
    let session = keeping(&server, 2, 2).await;
    let before = [seen(&server, &session, 2).await, seen(&server, &session, 3).await];
    let rewound = rewind(&server, &session, Some(1)).await.unwrap();
    assert_eq!((rewound.next_step, rewound.oldest_step), (2, None));
    // An observation that was answered before the return is a new one now.
    assert_eq!([seen(&server, &session, 2).await, seen(&server, &session, 3).await], before);
    assert!(!before[0].repeated);

    let status = rewind(&server, &session, Some(0)).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition);
    let details = status.get_error_details();
    assert_eq!(details.error_info().unwrap().reason, "STEP_NOT_KEPT");
    let violation = &details.bad_request().unwrap().field_violations[0];
    assert_eq!(violation.field, "to_step");
    assert!(violation.description.contains("a step of 1 to 3"), "{}", violation.description);
    let status = rewind(&server, &session, None).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    for never in [9, u64::MAX] {
        let status = rewind(&server, &session, Some(never)).await.unwrap_err();
        assert_eq!(status.code(), Code::FailedPrecondition, "{never}");
    }
    assert_eq!(server.next_step(&session).await, 4, "none of this moved it");
    let forgetful = server.seasoned(4, 2).await;
    let status = rewind(&server, &forgetful, Some(0)).await.unwrap_err();
    assert!(status.message().contains("keep_steps"), "{}", status.message());
    server.app.shutdown().await;
}

#[tokio::test]
async fn rest_forks_and_rewinds_as_well() {
    let server = TestServer::start().await;
    let session = keeping(&server, 2, 3).await;
    let path = format!("/v1/sessions/{}", session.id);
    let body = json!({ "count": 2, "at_step": 2 });
    let (status, forks) = server.post_json(&format!("{path}/fork"), &body).await;
    assert_eq!((status, forks["sessions"].as_array().unwrap().len()), (201, 2));
    assert_eq!(forks["sessions"][1]["oldest_step"], 0);
    let (status, rewound) =
        server.post_json(&format!("{path}/rewind"), &json!({ "to_step": 0 })).await;
    assert_eq!((status, rewound["session"]["next_step"].as_u64()), (200, Some(1)));
    let (status, problem) = server.post_json(&format!("{path}/fork"), &body).await;
    assert_eq!((status, problem["reason"].as_str()), (409, Some("SESSION_MOVED")));
    for (body, field) in [(json!({ "count": 0 }), "count"), (json!({ "count": 1001 }), "count")] {
        let (status, problem) = server.post_json(&format!("{path}/fork"), &body).await;
        assert_eq!((status, problem["fields"][0]["field"].as_str()), (400, Some(field)));
    }
    let (status, problem) =
        server.post_json(&format!("{path}/rewind"), &json!({ "to_step": 7 })).await;
    assert_eq!((status, problem["reason"].as_str()), (409, Some("STEP_NOT_KEPT")));
    server.app.shutdown().await;
}

#[tokio::test]
async fn there_is_only_so_much_room_for_the_past() {
    let server = TestServer::with(Config { max_kept_mib: 1, max_sessions: 3, ..config() }).await;
    let (status, problem) = server.post_json("/v1/sessions", &json!({ "keep_steps": 1000 })).await;
    assert_eq!((status, problem["fields"][0]["field"].as_str()), (400, Some("keep_steps")));
    let (status, first) = server.post_json("/v1/sessions", &json!({ "keep_frames": 18 })).await;
    assert_eq!((status, first["session"]["keep_frames"].as_u64()), (201, Some(18)));
    let (status, problem) = server.post_json("/v1/sessions", &json!({ "keep_frames": 18 })).await;
    assert_eq!((status, problem["reason"].as_str()), (429, Some("TOO_MUCH_KEPT")));
    assert!(problem["retry_after_millis"].as_u64().unwrap() > 3_000_000, "when the first expires");
    let id = first["session"]["id"].as_str().unwrap();
    // Forks keep for themselves, and are opened together or not at all.
    let (status, _) =
        server.post_json(&format!("/v1/sessions/{id}/fork"), &json!({ "count": 3 })).await;
    assert_eq!(status, 429);
    server.delete(&format!("/v1/sessions/{id}")).send().await.unwrap();
    let (status, _) = server.post_json("/v1/sessions", &json!({ "keep_frames": 18 })).await;
    assert_eq!(status, 201);
    server.app.shutdown().await;
}
