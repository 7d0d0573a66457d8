//! Streams and feeds end with their key, with an error that says why, and those of other keys go on.

use std::time::{Duration, SystemTime};

use gatsbi_proto::v1;
use gatsbi_server::{access::key::Role, config::Config};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};
use tonic_types::StatusExt as _;

use crate::{
    knock::KeyFile,
    support::{TestServer, config, observation},
    watching::Feed,
};

async fn soon<T>(answer: impl Future<Output = T>) -> T {
    tokio::time::timeout(Duration::from_mins(1), answer).await.expect("it is there in time")
}

/// A server with keys, and the file that they are in.
struct Guarded {
    server: TestServer,
    file: KeyFile,
    key: String,
}

/// A control loop, and where its observations go.
struct Loop {
    session: v1::Session,
    observations: mpsc::Sender<v1::ObserveStreamRequest>,
    answers: Streaming<v1::ObserveStreamResponse>,
}

/// Everything that a key keeps open.
struct Open {
    control_loop: Loop,
    predictions: Streaming<v1::PredictBatchResponse>,
    _requests: mpsc::Sender<v1::PredictBatchRequest>,
    feeds: Vec<reqwest::Response>,
}

impl Guarded {
    async fn start() -> Self {
        let mut file = KeyFile::new();
        let key = file.key("lab", Role::Predict);
        let keys = Some(file.0.path().to_owned());
        let server = TestServer::with(Config { keys, ..config() }).await;
        Self { server, file, key }
    }

    fn reload(&self) {
        self.server.app.access().unwrap().reload(config().quota()).unwrap();
    }

    async fn open(&self, key: &str) -> Open {
        let control_loop = self.control_loop(key).await;
        let (requests, received) = mpsc::channel(1);
        let request = with_key(ReceiverStream::new(received), key);
        let predictions = self.server.imagination.clone().predict_batch(request).await.unwrap();
        let mut feeds = Vec::new();
        for path in ["/v1/live", &format!("/v1/sessions/{}/live", control_loop.session.id)] {
            let feed = self.server.get(path).bearer_auth(key).send().await.unwrap();
            assert_eq!(feed.status(), 200, "{path}");
            feeds.push(feed);
        }
        let predictions = predictions.into_inner();
        Open { control_loop, predictions, _requests: requests, feeds }
    }

    async fn control_loop(&self, key: &str) -> Loop {
        let request = v1::CreateSessionRequest { seed: Some(1), ..Default::default() };
        let mut client = self.server.sessions.clone();
        let created = client.create_session(with_key(request, key)).await.unwrap().into_inner();
        let (observations, received) = mpsc::channel(1);
        let request = with_key(ReceiverStream::new(received), key);
        let answers = client.observe_stream(request).await.unwrap().into_inner();
        let mut control_loop = Loop { session: created.session.unwrap(), observations, answers };
        control_loop.step(0).await.unwrap();
        control_loop
    }
}

impl Loop {
    /// Observes a step; the error of a loop that has ended.
    async fn step(&mut self, step: u64) -> Result<(), Status> {
        let v1::ObserveRequest { session_id, observation, .. } = observation(&self.session, step);
        let request = v1::ObserveStreamRequest { session_id, observation, ..Default::default() };
        self.observations.send(request).await.ok();
        let answer = soon(self.answers.message()).await?.expect("an answer or an error");
        let answered = answer.result.unwrap();
        assert!(matches!(answered, v1::observe_stream_response::Result::Belief(_)), "{answered:?}");
        Ok(())
    }
}

impl Open {
    /// Waits until all has ended; every end says why.
    async fn ends(mut self, reason: &str) {
        let ended = soon(self.control_loop.answers.message()).await.unwrap_err();
        assert_typed(&ended, reason);
        assert_typed(&soon(self.predictions.message()).await.unwrap_err(), reason);
        for mut feed in self.feeds {
            let mut told = Vec::new();
            while let Some(part) = soon(feed.chunk()).await.unwrap() {
                told.extend_from_slice(&part);
            }
            let told = String::from_utf8(told).unwrap();
            let (_, last) = told.trim_end().rsplit_once("\n\n").expect("more than one event");
            assert!(last.starts_with("event: problem\n"), "{last}");
            assert!(last.contains(&format!("\"reason\":\"{reason}\"")), "{last}");
            assert!(last.contains("\"status\":401"), "{last}");
        }
    }
}

fn assert_typed(status: &Status, reason: &str) {
    assert_eq!(status.code(), Code::Unauthenticated, "{status:?}");
    assert_eq!(status.get_error_details().error_info().unwrap().reason, reason);
}

fn with_key<T>(message: T, key: &str) -> tonic::Request<T> {
    let mut request = tonic::Request::new(message);
    let bearer = format!("Bearer {key}").parse().unwrap();
    request.metadata_mut().insert("authorization", bearer);
    request
}

#[tokio::test]
async fn streams_and_feeds_end_when_their_key_is_taken_out() {
    let mut guarded = Guarded::start().await;
    let gone = guarded.file.key("lab", Role::Predict);
    guarded.reload();
    let open = guarded.open(&gone).await;
    let mut other = guarded.control_loop(&guarded.key).await;
    guarded.file.revoke(&gone);
    guarded.reload();
    open.ends("WRONG_KEY").await;
    other.step(1).await.unwrap();
    guarded.server.app.shutdown().await;
}

#[tokio::test]
async fn a_control_loop_ends_when_its_key_may_do_less() {
    let mut guarded = Guarded::start().await;
    let lowered = guarded.file.key("lab", Role::Predict);
    guarded.reload();
    let mut control_loop = guarded.control_loop(&lowered).await;
    let feed = guarded.server.get("/v1/live").bearer_auth(&lowered).send().await.unwrap();
    let mut feed = Feed::of(feed);
    assert_eq!(soon(feed.next()).await.unwrap().0, "overview");
    guarded.file.lower(&lowered, Role::Read);
    guarded.reload();
    let ended = soon(control_loop.answers.message()).await.unwrap_err();
    assert_eq!(ended.code(), Code::PermissionDenied, "{ended:?}");
    assert_eq!(ended.get_error_details().error_info().unwrap().reason, "ROLE_TOO_LOW");
    // What the role is enough for goes on.
    for _ in 0..2 {
        assert_eq!(soon(feed.next()).await.unwrap().0, "overview");
    }
    guarded.server.app.shutdown().await;
}

#[tokio::test]
async fn streams_and_feeds_end_when_their_key_expires() {
    let mut guarded = Guarded::start().await;
    let mut other = guarded.control_loop(&guarded.key).await;
    // Long enough to open all of it on a busy machine.
    let soon = SystemTime::now() + Duration::from_secs(8);
    let brief = guarded.file.key_until("lab", Role::Predict, Some(soon));
    guarded.reload();
    guarded.open(&brief).await.ends("EXPIRED_KEY").await;
    assert!(SystemTime::now() >= soon, "not before its time");
    other.step(1).await.unwrap();
    guarded.server.app.shutdown().await;
}
