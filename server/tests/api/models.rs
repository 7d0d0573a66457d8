//! Models that come and go while the server runs, and sessions that go over from one to another.

use std::path::Path;

use gatsbi_proto::v1::{self, SwapPolicy, admin_service_client::AdminServiceClient};
use gatsbi_server::config::Config;
use serde_json::{Value as Json, json};
use tonic::{Code, transport::Channel};
use tonic_types::StatusExt as _;

use crate::support::{
    TestServer, balls_checkpoint, checkpoint, checkpoint_of_another, config, observation, u8_image,
};

async fn administration(server: &TestServer) -> AdminServiceClient<Channel> {
    let channel = Channel::from_shared(format!("http://{}", server.app.admin)).unwrap();
    AdminServiceClient::new(channel.connect().await.unwrap())
}

async fn names(server: &TestServer) -> Vec<String> {
    let models = server.models.clone().list_models(v1::ListModelsRequest {}).await.unwrap();
    models.into_inner().models.into_iter().map(|model| model.name).collect()
}

fn load(path: &Path, name: &str) -> v1::LoadModelRequest {
    v1::LoadModelRequest { path: path.display().to_string(), name: name.to_owned() }
}

fn swap(path: &Path, policy: SwapPolicy) -> v1::SwapModelRequest {
    let (model, path) = ("tiny".to_owned(), path.display().to_string());
    v1::SwapModelRequest { model, path, policy: policy.into() }
}

/// What a session with the seed 4 sees next, whichever its seed is.
fn next(session: &v1::Session, step: u64) -> v1::ObserveRequest {
    let mut request = observation(session, step);
    let image = u8_image(64, 64, crate::support::picture(4, step));
    request.observation.as_mut().unwrap().image = Some(image);
    request
}

#[tokio::test]
async fn models_come_and_go_and_sessions_stay_on_theirs() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 1).await;
    let mut admin = administration(&server).await;
    let model = admin.load_model(load(checkpoint_of_another(), "second")).await.unwrap();
    let model = model.into_inner().model.unwrap();
    assert_eq!((model.name.as_str(), model.hash == session.model_hash), ("second", false));
    assert_eq!(names(&server).await, ["second", "tiny"]);
    let on_second = server.session_on("second", 4).await;
    assert_eq!(on_second.model_hash, model.hash);
    let belief = server.observe(next(&on_second, 0)).await.unwrap();
    assert_eq!(belief.model_hash, model.hash);
    server.observe(observation(&session, 1)).await.unwrap();

    // REST says the same.
    let url = format!("http://{}/v1/models", server.app.admin);
    let client = reqwest::Client::new();
    let body = json!({ "path": checkpoint_of_another(), "name": "second" });
    let taken = client.post(&url).json(&body).send().await.unwrap();
    assert_eq!(taken.status(), 409);
    assert_eq!(taken.json::<Json>().await.unwrap()["reason"], "MODEL_EXISTS");
    let used = client.delete(format!("{url}/second")).send().await.unwrap();
    assert_eq!(used.status(), 409);
    assert_eq!(used.json::<Json>().await.unwrap()["reason"], "MODEL_IN_USE");
    let gone = client.delete(format!("{url}/second?close_sessions=true")).send().await.unwrap();
    assert_eq!(gone.json::<Json>().await.unwrap()["closed_sessions"], 1);
    assert_eq!(names(&server).await, ["tiny"]);
    let status = server.observe(next(&on_second, 1)).await.unwrap_err();
    assert_eq!(status.code(), Code::NotFound);
    server.observe(observation(&session, 2)).await.unwrap();
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_bad_checkpoint_never_takes_down_a_good_one() {
    let folder = tempfile::tempdir().unwrap();
    let broken = folder.path().join("broken.safetensors");
    std::fs::write(&broken, b"nonsense").unwrap();
    std::fs::copy(checkpoint(), folder.path().join("good.safetensors")).unwrap();
    let mut cut = std::fs::read(checkpoint()).unwrap();
    cut.truncate(cut.len() / 2);
    std::fs::write(folder.path().join("cut.safetensors"), cut).unwrap();
    let checkpoint_folder = Some(folder.path().to_owned());
    let config = Config { checkpoints: Vec::new(), checkpoint_folder, ..config() };
    let server = TestServer::with(config).await;
    assert_eq!(names(&server).await, ["tiny"], "the good one in the folder");
    let session = server.seasoned(4, 1).await;
    let mut admin = administration(&server).await;
    for path in ["broken.safetensors", "cut.safetensors", "missing.safetensors"] {
        let status = admin.load_model(load(Path::new(path), "other")).await.unwrap_err();
        assert_eq!(status.code(), Code::InvalidArgument);
        let details = status.get_error_details();
        assert_eq!(details.error_info().unwrap().reason, "BAD_CHECKPOINT");
        assert_eq!(details.bad_request().unwrap().field_violations[0].field, "path");
        let status = admin.swap_model(swap(Path::new(path), SwapPolicy::Close)).await.unwrap_err();
        assert_eq!(status.get_error_details().error_info().unwrap().reason, "BAD_CHECKPOINT");
    }
    admin.load_model(load(Path::new("good.safetensors"), "again")).await.unwrap();
    server.observe(observation(&session, 1)).await.unwrap();
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_swapped_session_believes_what_it_would_have_on_the_new_model() {
    let server = TestServer::start().await;
    let open = async |keep_frames: u32| {
        let request = v1::CreateSessionRequest {
            seed: Some(4),
            keep_frames,
            keep_steps: 2,
            ..Default::default()
        };
        let session = server.sessions.clone().create_session(request).await.unwrap();
        session.into_inner().session.unwrap()
    };
    let (all, some, none, fresh) = (open(8).await, open(2).await, open(0).await, open(0).await);
    for session in [&all, &some, &none] {
        for step in 0..3 {
            server.observe(observation(session, step)).await.unwrap();
        }
    }
    let mut admin = administration(&server).await;
    let other = checkpoint_of_another();
    let swapped = admin.swap_model(swap(other, SwapPolicy::Replay)).await.unwrap().into_inner();
    assert_eq!((swapped.moved_sessions, swapped.closed_sessions), (3, 1));
    let hash = swapped.model.unwrap().hash;
    assert_eq!(names(&server).await, ["tiny"]);
    let status = server.observe(next(&none, 3)).await.unwrap_err();
    assert_eq!(status.code(), Code::NotFound);

    // One that saw the same on the new model from the start.
    let twin = server.seasoned(4, 3).await;
    assert_eq!(twin.model_hash, hash);
    let expected = server.observe(next(&twin, 3)).await.unwrap();
    let moved = server.observe(next(&all, 3)).await.unwrap();
    assert_eq!(moved.outputs, expected.outputs);
    assert_eq!((moved.step, moved.model_hash.as_str()), (3, hash.as_str()));
    let forgetful = server.observe(next(&some, 3)).await.unwrap();
    assert_eq!((forgetful.step, &forgetful.model_hash), (3, &hash));
    assert_ne!(forgetful.outputs, expected.outputs, "it saw the last two frames only");
    assert_eq!(server.observe(next(&fresh, 0)).await.unwrap().model_hash, hash);
    let request = v1::RewindSessionRequest { session_id: all.id.clone(), to_step: Some(1) };
    let status = server.sessions.clone().rewind_session(request).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition, "beliefs of the old model are gone");

    // Back, and nobody notices but new sessions.
    let back = swap(checkpoint(), SwapPolicy::Drain);
    let drained = admin.swap_model(back).await.unwrap().into_inner();
    assert_eq!((drained.moved_sessions, drained.closed_sessions), (0, 0));
    assert_eq!(server.observe(next(&all, 4)).await.unwrap().model_hash, hash);
    assert_ne!(server.session(1).await.model_hash, hash);
    let close = swap(checkpoint(), SwapPolicy::Close);
    let closed = admin.swap_model(close).await.unwrap().into_inner();
    assert_eq!((closed.moved_sessions, closed.closed_sessions), (0, 5));
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_swap_for_what_sees_otherwise_is_refused() {
    let server = TestServer::start().await;
    let session = server.seasoned(4, 1).await;
    let mut admin = administration(&server).await;
    let status = admin.swap_model(swap(balls_checkpoint(), SwapPolicy::Replay)).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    assert!(status.message().contains("actions []"), "{}", status.message());
    let mut unknown = swap(checkpoint(), SwapPolicy::Close);
    unknown.policy = 9;
    let status = admin.swap_model(unknown).await.unwrap_err();
    assert!(status.message().contains("policy"), "{}", status.message());
    let url = format!("http://{}/v1/models/tiny", server.app.admin);
    let body = json!({ "path": "x", "model": "other" });
    let refused = reqwest::Client::new().put(&url).json(&body).send().await.unwrap();
    assert_eq!(refused.status(), 400);
    server.observe(observation(&session, 1)).await.unwrap();
    server.app.shutdown().await;
}
