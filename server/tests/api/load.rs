//! Too much to do: what is refused, what is late, what is given up, and who goes first.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

use gatsbi_models::{
    noise::Noise,
    scene::{Outputs, Scene},
    state::{State, StateLayout},
    world_model::{ModelSpec, WorldModel},
};
use gatsbi_proto::v1;
use gatsbi_server::config::Config;
use prost::Message as _;
use tch::{Device, Tensor};
use tokio::task::JoinHandle;
use tonic::Code;
use tonic_types::StatusExt as _;

use crate::support::{TestServer, config, named, observation, rollout};

/// A server that takes on one rollout of 16 rows at a time.
async fn narrow(name: &str) -> TestServer {
    let sizes = Config { max_rows: 16, max_request_rows: 16, imagine_block: 4, ..named(name) };
    TestServer::with(sizes).await
}

/// Asks for a rollout until it is let in.
async fn until_there_is_room(server: &TestServer, session: &v1::Session) {
    let began = std::time::Instant::now();
    while let Err(refused) = server.imagine(rollout(session, 16, 1)).await {
        assert_eq!(refused.code(), Code::ResourceExhausted);
        assert!(began.elapsed().as_secs() < 20, "the rows were not given back");
    }
}

/// Fetches a rollout's chunks as they come, and counts them.
async fn counted(
    server: &TestServer,
    request: v1::ImagineRequest,
) -> (Arc<AtomicUsize>, JoinHandle<()>) {
    let mut chunks = server.imagination.clone().imagine(request).await.unwrap().into_inner();
    chunks.message().await.unwrap().unwrap();
    let count = Arc::new(AtomicUsize::new(1));
    let counting = Arc::clone(&count);
    let fetching = tokio::spawn(async move {
        while chunks.message().await.unwrap().is_some() {
            counting.fetch_add(1, Ordering::Relaxed);
        }
    });
    (count, fetching)
}

#[tokio::test]
async fn too_many_rows_are_refused_until_some_are_given_back() {
    let server = narrow("narrow").await;
    let session = server.seasoned(4, 1).await;
    let long = rollout(&session, 16, 200);
    let mut first = server.imagination.clone().imagine(long.clone()).await.unwrap().into_inner();
    first.message().await.unwrap().unwrap();

    let refused = server.imagine(rollout(&session, 1, 1)).await.unwrap_err();
    assert_eq!(refused.code(), Code::ResourceExhausted);
    let retry = refused.get_details_retry_info().unwrap().retry_delay.unwrap();
    assert!(retry.as_secs_f64() > 1.0, "3200 row steps take longer than {retry:?}");
    let path = format!("/v1/sessions/{}/rollouts", session.id);
    let body = rollout(&session, 1, 1).encode_to_vec();
    let request = server.post(&path).header("content-type", "application/x-protobuf").body(body);
    let refused = request.send().await.unwrap();
    assert_eq!(refused.status(), 429);
    assert!(refused.headers().contains_key("retry-after"));

    // Who goes away makes room, long before his rollout would have ended.
    drop(first);
    until_there_is_room(&server, &session).await;
    let given_up = server.metric("gatsbi_given_up_total{model=\"narrow\"}").await;
    assert!((given_up - 1.0).abs() < 1e-9, "{given_up}");
    assert!(server.metric("gatsbi_refusals_total{reason=\"OVERLOADED\"}").await >= 2.0);
    server.app.shutdown().await;
}

#[tokio::test]
async fn what_would_come_too_late_is_refused_at_once_with_the_estimate() {
    let server = narrow("tiny").await;
    let session = server.seasoned(4, 1).await;
    let mut request = rollout(&session, 16, 200);
    request.timeout_millis = Some(300);
    let began = std::time::Instant::now();
    let refused = server.imagine(request.clone()).await.unwrap_err();
    assert!(began.elapsed().as_millis() < 300, "at once");
    assert_eq!(refused.code(), Code::DeadlineExceeded);
    let details = refused.get_error_details();
    assert_eq!(details.error_info().unwrap().reason, "TOO_SLOW");
    assert!(details.retry_info().is_none(), "it will never be fast enough");
    assert!(refused.message().starts_with("the answer needs "), "{}", refused.message());

    // The deadline of the call itself counts as well, and REST says the same.
    let mut call = tonic::Request::new(rollout(&session, 16, 200));
    call.set_timeout(std::time::Duration::from_millis(300));
    let refused = server.imagination.clone().imagine(call).await.unwrap_err();
    assert_eq!(refused.code(), Code::DeadlineExceeded);
    let path = format!("/v1/sessions/{}/rollouts", session.id);
    let body = request.encode_to_vec();
    let refused = server.post(&path).header("content-type", "application/x-protobuf").body(body);
    let refused = refused.send().await.unwrap();
    assert_eq!(refused.status(), 504);
    assert_eq!(refused.json::<serde_json::Value>().await.unwrap()["reason"], "TOO_SLOW");
}

#[tokio::test]
async fn what_becomes_late_ends_and_makes_room() {
    let server = TestServer::behind(
        Config { max_rows: 16, max_request_rows: 16, imagine_block: 4, ..config() },
        |world| Box::new(Slow(world)),
    )
    .await;
    let session = server.seasoned(4, 1).await;
    let mut request = rollout(&session, 1, 40);
    let mut actions = crate::support::actions(1, 40, 3);
    actions[5 * crate::support::ACTION] = SLOW;
    request.actions = Some(crate::support::f32_tensor(&[1, 40, 7], &actions));
    request.timeout_millis = Some(4000);
    let mut answers = server.imagination.clone().imagine(request).await.unwrap().into_inner();
    let (status, chunks) = {
        let mut chunks = 0;
        loop {
            match answers.message().await {
                Ok(answer) => assert!(!answer.unwrap().chunk.unwrap().last),
                Err(status) => break (status, chunks),
            }
            chunks += 1;
        }
    };
    assert_eq!((status.code(), chunks), (Code::DeadlineExceeded, 5), "five steps came in time");
    until_there_is_room(&server, &session).await;

    let mut request = observation(&session, 1);
    request.observation.as_mut().unwrap().action[0] = SLOW;
    request.timeout_millis = Some(4000);
    let late = server.observe(request).await.unwrap_err();
    assert_eq!(late.code(), Code::DeadlineExceeded);
    assert_eq!(server.next_step(&session).await, 1);
    assert!(!server.observe(observation(&session, 1)).await.unwrap().repeated);
    server.app.shutdown().await;
}

/// First number of an action that makes the model slow.
const SLOW: f32 = 888.0;

/// A real model that takes its time with certain actions.
struct Slow(Box<dyn WorldModel>);

impl Slow {
    fn wait(action: &Tensor) {
        if action.select(1, 0).eq(f64::from(SLOW)).any().int64_value(&[]) != 0 {
            std::thread::sleep(std::time::Duration::from_secs(5));
        }
    }
}

impl WorldModel for Slow {
    fn spec(&self) -> &ModelSpec {
        self.0.spec()
    }

    fn layout(&self) -> &StateLayout {
        self.0.layout()
    }

    fn device(&self) -> Device {
        self.0.device()
    }

    fn initial_state(&self, batch: i64) -> State {
        self.0.initial_state(batch)
    }

    fn observe(
        &self,
        state: &State,
        frame: Option<&Tensor>,
        action: &Tensor,
        noise: &dyn Noise,
        wanted: Outputs,
    ) -> (State, Scene) {
        Self::wait(action);
        self.0.observe(state, frame, action, noise, wanted)
    }

    fn imagine(
        &self,
        state: &State,
        action: &Tensor,
        noise: &dyn Noise,
        wanted: Outputs,
    ) -> (State, Scene) {
        Self::wait(action);
        self.0.imagine(state, action, noise, wanted)
    }
}

#[tokio::test]
async fn observations_go_before_rollouts() {
    let server = narrow("tiny").await;
    let session = server.seasoned(4, 1).await;
    let (count, fetching) = counted(&server, rollout(&session, 16, 60)).await;
    for step in 1..4 {
        server.observe(observation(&session, step)).await.unwrap();
    }
    let before = count.load(Ordering::Relaxed);
    fetching.await.unwrap();
    let total = count.load(Ordering::Relaxed);
    assert!(total >= 240 && before < total / 2, "{before} of {total} chunks came before");
    server.app.shutdown().await;
}

#[tokio::test]
async fn two_rollouts_advance_side_by_side() {
    let server = TestServer::with(Config { imagine_block: 4, tick_millis: 0, ..config() }).await;
    let session = server.seasoned(4, 1).await;
    let (count, fetching) = counted(&server, rollout(&session, 16, 40)).await;
    // It comes later and is done sooner.
    server.imagine(rollout(&session, 2, 5)).await.unwrap();
    let before = count.load(Ordering::Relaxed);
    fetching.await.unwrap();
    let total = count.load(Ordering::Relaxed);
    assert!(total >= 160 && before < total / 2, "{before} of {total} chunks came before");
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_tenant_with_many_rollouts_does_not_crowd_out_another() {
    let config = Config { workers: 1, imagine_block: 4, tick_millis: 0, ..config() };
    let server = TestServer::with(config).await;
    let (many, one) = (server.seasoned(4, 1).await, server.seasoned(5, 1).await);
    let mut counts = Vec::new();
    for _ in 0..5 {
        counts.push(counted(&server, rollout(&many, 16, 40)).await);
    }
    // Named by its metadata, a client is one tenant whatever its sessions are.
    let mut call = tonic::Request::new(rollout(&one, 16, 10));
    call.metadata_mut().insert("gatsbi-tenant", "another".parse().unwrap());
    let mut chunks = server.imagination.clone().imagine(call).await.unwrap().into_inner();
    let mut steps = 0;
    while let Some(answer) = chunks.message().await.unwrap() {
        steps += answer.chunk.unwrap().candidates as usize;
    }
    assert_eq!(steps, 160);
    let before: usize = counts.iter().map(|(count, _)| count.load(Ordering::Relaxed)).sum();
    for (_, fetching) in &counts {
        fetching.abort();
    }
    // Each got half of the model, so the five together have made about as many steps, in chunks of one or more.
    assert!(before <= 320, "{before} chunks came before");
    server.app.shutdown().await;
}

#[tokio::test]
async fn streams_end_when_the_server_does() {
    let server = TestServer::with(Config { drain_seconds: 3, ..config() }).await;
    let session = server.seasoned(4, 1).await;
    let (observations, received) = tokio::sync::mpsc::channel(1);
    let stream = tokio_stream::wrappers::ReceiverStream::new(received);
    let v1::ObserveRequest { session_id, observation, outputs, .. } = observation(&session, 1);
    let first = v1::ObserveStreamRequest { session_id, observation, outputs, timeout_millis: None };
    observations.send(first).await.unwrap();
    let mut answers = server.sessions.clone().observe_stream(stream).await.unwrap().into_inner();
    answers.message().await.unwrap().unwrap();
    let began = std::time::Instant::now();
    let ended = tokio::spawn(async move { answers.message().await });
    let TestServer { app, models, sessions, imagination, .. } = server;
    drop((models, sessions, imagination));
    app.shutdown().await;
    let status = ended.await.unwrap().unwrap_err();
    assert_eq!(status.code(), Code::Unavailable);
    assert!(began.elapsed().as_secs() < 8);
}
