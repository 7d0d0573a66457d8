//! Beliefs as bytes: what goes on from them goes on as before, and what is no belief is refused.

use base64::{Engine as _, prelude::BASE64_STANDARD};
use bytes::Bytes;
use gatsbi_proto::v1;
use serde_json::{Value as Json, json};
use tonic::{Code, Status};
use tonic_types::StatusExt as _;

use crate::support::{TestServer, observation, other_checkpoint, serving_both};

async fn export(server: &TestServer, session: &v1::Session) -> v1::ExportSessionResponse {
    let request = v1::ExportSessionRequest { session_id: session.id.clone(), ..Default::default() };
    server.sessions.clone().export_session(request).await.unwrap().into_inner()
}

async fn import(
    server: &TestServer,
    snapshot: Bytes,
    session_id: &str,
) -> Result<v1::Session, Status> {
    let session_id = session_id.to_owned();
    let request = v1::ImportSessionRequest { snapshot, session_id, ..Default::default() };
    Ok(server.sessions.clone().import_session(request).await?.into_inner().session.unwrap())
}

/// What a session says to its next step, which is made up for the original.
async fn goes_on(server: &TestServer, session: &v1::Session) -> v1::Belief {
    let belief = server.observe(observation(session, 2)).await.unwrap();
    v1::Belief { session_id: String::new(), timing: None, ..belief }
}

#[tokio::test]
async fn a_belief_goes_on_from_its_bytes() {
    let (server, other) = (TestServer::start().await, TestServer::start().await);
    let session = server.seasoned(4, 2).await;
    let exported = export(&server, &session).await;
    assert_eq!(exported.session.unwrap().next_step, 2);
    assert!(exported.snapshot.len() < 65_536, "{} bytes", exported.snapshot.len());
    let expected = goes_on(&server, &session).await;

    let anew = import(&other, exported.snapshot.clone(), "").await.unwrap();
    assert_eq!((anew.next_step, anew.seed, anew.mode()), (2, 4, v1::Mode::Sample));
    assert_eq!(goes_on(&other, &anew).await, expected);

    // The original goes back to where it was, in one that has seen other things.
    let back = import(&server, exported.snapshot.clone(), &session.id).await.unwrap();
    assert_eq!((back.id.as_str(), back.next_step), (session.id.as_str(), 2));
    assert_eq!(goes_on(&server, &session).await, expected);
    let elsewhere = server.seasoned(9, 1).await;
    let elsewhere = import(&server, exported.snapshot.clone(), &elsewhere.id).await.unwrap();
    assert_eq!(goes_on(&server, &elsewhere).await, expected);

    // Exported again, it is the same.
    let again = import(&server, exported.snapshot.clone(), "").await.unwrap();
    assert_eq!(export(&server, &again).await.snapshot, exported.snapshot);
    server.app.shutdown().await;
    other.app.shutdown().await;
}

#[tokio::test]
async fn rest_carries_snapshots_as_json_and_as_bytes() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 2).await;
    let path = format!("/v1/sessions/{}/snapshot", session.id);
    let exported: Json = server.get(&path).send().await.unwrap().json().await.unwrap();
    let text = exported["snapshot"].as_str().unwrap();
    let octets = "application/octet-stream";
    let bytes = server.get(&path).header("accept", octets).send().await.unwrap();
    assert_eq!(bytes.headers()["content-type"], octets);
    let bytes = bytes.bytes().await.unwrap();
    assert_eq!(BASE64_STANDARD.decode(text).unwrap(), bytes);
    assert_eq!(exported["session"]["next_step"], 2);
    let expected = goes_on(&server, &session).await;

    let put = |body: reqwest::RequestBuilder| async {
        let answer = body.send().await.unwrap();
        (answer.status().as_u16(), answer.json::<Json>().await.unwrap())
    };
    let raw = server.put(&path).header("content-type", octets).body(bytes.clone());
    let (status, answer) = put(raw).await;
    assert_eq!((status, answer["session"]["next_step"].as_u64()), (200, Some(2)));
    assert_eq!(goes_on(&server, &session).await, expected);
    let (status, _) = put(server.put(&path).json(&json!({ "snapshot": text }))).await;
    assert_eq!(status, 200);
    let anew = json!({ "snapshot": text, "label": "again", "keep_steps": 2, "ttl": "30s" });
    let (status, answer) = server.post_json("/v1/snapshots", &anew).await;
    assert_eq!((status, answer["session"]["label"].as_str()), (201, Some("again")));
    assert_eq!(answer["session"]["keep_steps"], 2);

    let (status, problem) = put(server.put(&path).json(&anew)).await;
    assert_eq!((status, problem["fields"][0]["field"].as_str()), (400, Some("label")));
    let at = server.get(&format!("{path}?at_step=9")).send().await.unwrap();
    assert_eq!(at.status(), 409);
    let wrong = server.get(&format!("{path}?step=9")).send().await.unwrap();
    assert_eq!(wrong.status(), 400);
    server.app.shutdown().await;
}

#[tokio::test]
async fn what_is_no_belief_is_refused_on_both_apis() {
    let server = serving_both().await;
    let session = server.session_on("tiny", 4).await;
    server.observe(observation(&session, 0)).await.unwrap();
    let before = export(&server, &session).await.snapshot;
    let mut altered = before.to_vec();
    altered[1000] ^= 4;
    let foreign = TestServer::with(other_checkpoint()).await;
    let stranger = foreign.seasoned(4, 1).await;
    let elsewhere = export(&foreign, &stranger).await.snapshot;
    let neighbour = server.session_on("balls", 4).await;
    let path = format!("/v1/sessions/{}/snapshot", session.id);
    for (bytes, reason, says) in [
        (Bytes::new(), "INVALID_FIELDS", "0 bytes of something else"),
        (Bytes::from_static(b"GIF89a.."), "INVALID_FIELDS", "something else"),
        (before.slice(..before.len() / 2), "INVALID_FIELDS", &format!("{} bytes", before.len())),
        (altered.into(), "INVALID_FIELDS", "is altered"),
        (elsewhere.clone(), "FOREIGN_SNAPSHOT", "of checkpoint"),
    ] {
        let status = import(&server, bytes.clone(), &session.id).await.unwrap_err();
        let details = status.get_error_details();
        assert_eq!(details.error_info().unwrap().reason, reason, "{status:?}");
        let violation = &details.bad_request().unwrap().field_violations[0];
        assert_eq!(violation.field, "snapshot");
        assert!(violation.description.contains(says), "{}", violation.description);
        let body = json!({ "snapshot": BASE64_STANDARD.encode(&bytes) });
        let answer = server.put(&path).json(&body).send().await.unwrap();
        let problem: Json = answer.json().await.unwrap();
        assert_eq!(problem["reason"], reason);
        assert_eq!(problem["fields"][0]["field"], "snapshot");
    }
    // As a new session it lacks a model, and on another model's session it means nothing.
    let status = import(&server, elsewhere, "").await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition);
    assert!(status.message().contains("not served here"), "{}", status.message());
    let status = import(&server, before.clone(), &neighbour.id).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition);
    assert_eq!(export(&server, &session).await.snapshot, before, "none of this changed it");
    server.app.shutdown().await;
    foreign.app.shutdown().await;
}
