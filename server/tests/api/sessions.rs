//! Models and sessions: what is there, opened, listed and closed, the same on both APIs.

use gatsbi_proto::v1;
use prost::Message as _;
use serde_json::json;
use tonic::Code;
use tonic_reflection::pb::v1::{
    ServerReflectionRequest, server_reflection_client::ServerReflectionClient,
    server_reflection_request::MessageRequest, server_reflection_response::MessageResponse,
};

use crate::support::{ACTION, TestServer, config, observation, outputs, serving_both};

#[tokio::test]
async fn models_are_described_on_both_apis() {
    let server = TestServer::start().await;
    let models = server.models.clone().list_models(v1::ListModelsRequest {}).await.unwrap();
    let model = models.into_inner().models.remove(0);
    assert_eq!((model.name.as_str(), model.image_size, model.slots), ("tiny", 64, 3));
    assert_eq!(model.actions.len(), 7);
    assert_eq!((model.actions[1].name.as_str(), model.actions[1].offset), ("joint 1", 0.25));
    assert_eq!((model.agent_slot, model.max_objects, model.trained_steps), (Some(0), 7, 0));
    assert_eq!(model.preprocess(), v1::Preprocess::CentreCrop);
    assert_eq!(model.card, "# Tiny\n");
    assert_eq!(model.hash.len(), 64);
    assert_eq!(model.limits.unwrap().max_horizon, 256);

    let rest: serde_json::Value =
        server.get("/v1/models/tiny").send().await.unwrap().json().await.unwrap();
    assert_eq!(rest["model"]["hash"], model.hash);
    assert_eq!(rest["model"]["actions"][1]["unit"], "rad/s");
    let all: serde_json::Value =
        server.get("/v1/models").send().await.unwrap().json().await.unwrap();
    assert_eq!(all["models"][0], rest["model"]);
    let unknown = server.get("/v1/models/huge").send().await.unwrap();
    assert_eq!(unknown.status(), 404);
    let request = v1::GetModelRequest { model: "huge".to_owned() };
    let unknown = server.models.clone().get_model(request).await.unwrap_err();
    assert_eq!(
        (unknown.code(), unknown.message()),
        (Code::NotFound, "there is no model huge, but tiny")
    );
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_session_is_one_and_the_same_on_both_apis() {
    let server = TestServer::start().await;
    let body = json!({ "label": "left arm", "seed": 9, "mode": "MODE_MEAN", "ttl": "60s" });
    let (status, created) = server.post_json("/v1/sessions", &body).await;
    assert_eq!(status, 201);
    let id = created["session"]["id"].as_str().unwrap().to_owned();
    assert_eq!((id.len(), created["session"]["seed"].as_u64()), (32, Some(9)));

    let request = v1::GetSessionRequest { session_id: id.clone() };
    let session = server.sessions.clone().get_session(request.clone()).await.unwrap();
    let session = session.into_inner().session.unwrap();
    assert_eq!((session.label.as_str(), session.model.as_str()), ("left arm", "tiny"));
    assert_eq!((session.mode(), session.next_step), (v1::Mode::Mean, 0));
    let expires = session.expires_at.unwrap().seconds - session.used_at.unwrap().seconds;
    assert_eq!(expires, 60);

    let deleted = server.delete(&format!("/v1/sessions/{id}")).send().await.unwrap();
    assert_eq!(deleted.status(), 200);
    let gone = server.sessions.clone().get_session(request).await.unwrap_err();
    assert_eq!(gone.code(), Code::NotFound);
    let gone = server.observe(observation(&session, 0)).await.unwrap_err();
    assert_eq!(gone.code(), Code::NotFound);
    server.app.shutdown().await;
}

#[tokio::test]
async fn an_idle_session_is_two_beliefs_and_the_frame_between() {
    let server = TestServer::start().await;
    let session = server.session(1).await;
    let selection = outputs(&[v1::Output::Objects], v1::Encoding::U8);
    let request = |step| v1::ObserveRequest {
        outputs: Some(selection.clone()),
        ..observation(&session, step)
    };
    let mut answer = 0;
    for step in 0..3 {
        answer = server.observe(request(step)).await.unwrap().encoded_len();
    }
    let told = v1::GetSessionRequest { session_id: session.id.clone() };
    let told = server.sessions.clone().get_session(told).await.unwrap().into_inner();
    let bytes = told.session.unwrap().bytes as usize;
    assert!(bytes.abs_diff(2 * 16_816 + 64 * 64 * 3 + ACTION * 4 + answer) < 16, "{bytes}");
    assert!(bytes <= 65_536);
    server.app.shutdown().await;
}

#[tokio::test]
async fn sessions_are_listed_page_by_page() {
    let server = TestServer::start().await;
    for label in ["a", "b", "a", "a"] {
        let request = v1::CreateSessionRequest { label: label.to_owned(), ..Default::default() };
        server.sessions.clone().create_session(request).await.unwrap();
    }
    let request =
        v1::ListSessionsRequest { page_size: Some(2), label: "a".to_owned(), ..Default::default() };
    let first = server.sessions.clone().list_sessions(request).await.unwrap().into_inner();
    assert_eq!(first.sessions.len(), 2);
    let path = format!("/v1/sessions?page_size=2&label=a&page_token={}", first.next_page_token);
    let second: serde_json::Value = server.get(&path).send().await.unwrap().json().await.unwrap();
    assert_eq!(second["sessions"].as_array().unwrap().len(), 1);
    assert_eq!(second["next_page_token"], "");
    let seeds: std::collections::BTreeSet<u64> =
        first.sessions.iter().map(|session| session.seed).collect();
    assert_eq!(seeds.len(), 2, "each drew a seed of its own");
    assert!(seeds.iter().all(|seed| *seed < 1 << 53));
    server.app.shutdown().await;
}

#[tokio::test]
async fn there_are_only_so_many_sessions() {
    let server =
        TestServer::with(gatsbi_server::config::Config { max_sessions: 1, ..config() }).await;
    server.session(1).await;
    let refused = server.post("/v1/sessions").send().await.unwrap();
    assert_eq!(refused.status(), 429);
    let seconds: u64 = refused.headers()["retry-after"].to_str().unwrap().parse().unwrap();
    assert!((3590..=3600).contains(&seconds), "when the one expires: {seconds}");
    let problem: serde_json::Value = refused.json().await.unwrap();
    assert_eq!(problem["reason"], "TOO_MANY_SESSIONS");
    server.app.shutdown().await;
}

#[tokio::test]
async fn several_models_are_served_side_by_side() {
    let server = serving_both().await;
    let (status, problem) = server.post_json("/v1/sessions", &json!({})).await;
    assert_eq!((status, problem["fields"][0]["field"].as_str()), (400, Some("model")));
    let tiny = v1::CreateSessionRequest { model: "tiny".to_owned(), ..Default::default() };
    let balls = v1::CreateSessionRequest { model: "balls".to_owned(), ..Default::default() };
    let mut sessions = server.sessions.clone();
    let tiny = sessions.create_session(tiny).await.unwrap().into_inner().session.unwrap();
    let balls = sessions.create_session(balls).await.unwrap().into_inner().session.unwrap();
    let mut request = observation(&balls, 0);
    request.observation.as_mut().unwrap().action.clear();
    let (first, second) =
        tokio::join!(server.observe(observation(&tiny, 0)), server.observe(request));
    assert_ne!(first.unwrap().model_hash, second.unwrap().model_hash);
    server.app.shutdown().await;
}

#[tokio::test]
async fn health_readiness_metrics_and_reflection_are_there() {
    let server = TestServer::start().await;
    server.seasoned(1, 2).await;
    assert_eq!(server.admin("/healthz").await.status(), 200);
    assert_eq!(server.admin("/readyz").await.status(), 200);
    let metrics = server.admin("/metrics").await.text().await.unwrap();
    for name in [
        "gatsbi_requests_total{api=\"grpc\",method=\"Observe\",result=\"OK\"}",
        "gatsbi_step_duration_seconds_bucket{model=\"tiny\",kind=\"observe\"",
        "gatsbi_queue_duration_seconds_count",
        "gatsbi_sessions",
    ] {
        assert!(metrics.contains(name), "{name} is missing in\n{metrics}");
    }
    let channel = tonic::transport::Channel::from_shared(format!("http://{}", server.app.grpc));
    let channel = channel.unwrap().connect().await.unwrap();
    let mut health = tonic_health::pb::health_client::HealthClient::new(channel.clone());
    let request =
        tonic_health::pb::HealthCheckRequest { service: "gatsbi.v1.SessionService".to_owned() };
    assert_eq!(health.check(request).await.unwrap().into_inner().status, 1);
    let request = ServerReflectionRequest {
        message_request: Some(MessageRequest::ListServices(String::new())),
        ..Default::default()
    };
    let mut answers = ServerReflectionClient::new(channel)
        .server_reflection_info(tokio_stream::once(request))
        .await
        .unwrap()
        .into_inner();
    let answer = answers.message().await.unwrap().unwrap().message_response;
    let Some(MessageResponse::ListServicesResponse(services)) = answer else {
        panic!("{answer:?}")
    };
    let names: Vec<&str> = services.service.iter().map(|service| service.name.as_str()).collect();
    assert!(names.contains(&"gatsbi.v1.PlanningService"), "{names:?}");
    server.app.shutdown().await;
}

#[tokio::test]
async fn what_is_not_there_yet_says_so() {
    let server = TestServer::start().await;
    let session = server.session(1).await;
    let path = format!("/v1/sessions/{}/rollouts", session.id);
    let (status, problem) = server.post_json(&path, &json!({"costs": {}})).await;
    assert_eq!((status, problem["reason"].as_str()), (501, Some("UNIMPLEMENTED")));
    server.app.shutdown().await;
}
