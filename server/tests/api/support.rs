//! A server of its own for every test, its clients, and made-up observations.

use std::{
    path::{Path, PathBuf},
    sync::OnceLock,
};

use gatsbi_models::{
    checkpoint::{AgentSlot, Checkpoint, FirstAction, Header, Precision, Provenance},
    config::presets,
    gatsbi::world::GatsbiWorld,
    world_model::{ActionDimension, Preprocess, WorldModel},
};
use gatsbi_proto::v1::{
    self, image::Content, imagination_service_client::ImaginationServiceClient,
    model_service_client::ModelServiceClient, output_value::Value,
    planning_service_client::PlanningServiceClient, session_service_client::SessionServiceClient,
};
use gatsbi_server::{
    app::{self, App},
    config::{CheckpointArg, Config},
    engine::models::LoadedModel,
};
use serde_json::Value as Json;
use tch::Device;
use tonic::transport::Channel;

/// Dimensions of an action.
pub(crate) const ACTION: usize = 7;

/// A running server and its clients.
pub(crate) struct TestServer {
    pub(crate) app: App,
    pub(crate) models: ModelServiceClient<Channel>,
    pub(crate) sessions: SessionServiceClient<Channel>,
    pub(crate) imagination: ImaginationServiceClient<Channel>,
    pub(crate) planning: PlanningServiceClient<Channel>,
    http: reqwest::Client,
}

/// A checkpoint of the tiny preset with untrained weights.
pub(crate) fn checkpoint() -> &'static Path {
    static FILE: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    &FILE.get_or_init(|| tiny(5)).1
}

/// Another one, that differs in its provenance alone, and so in its hash.
pub(crate) fn checkpoint_of_another() -> &'static Path {
    static FILE: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    &FILE.get_or_init(|| tiny(6)).1
}

fn tiny(seed: u64) -> (tempfile::TempDir, PathBuf) {
    let action = |i: usize| ActionDimension {
        name: format!("joint {i}"),
        unit: "rad/s".to_owned(),
        offset: 0.25,
        scale: 0.5,
    };
    let header = Header {
        name: "tiny".to_owned(),
        model: presets::tiny(),
        agent_slot: Some(AgentSlot { index: 0, score: None }),
        actions: (0..ACTION).map(action).collect(),
        preprocess: Preprocess::CentreCrop,
        frame_period: Some(0.2),
        first_action: FirstAction::Neutral,
        provenance: Provenance { seed, ..Provenance::default() },
    };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tiny.safetensors");
    Checkpoint::untrained(header, Device::Cpu).save(&path, Precision::Single).unwrap();
    std::fs::write(path.with_extension("md"), "# Tiny\n").unwrap();
    (folder, path)
}

fn balls_header() -> Header {
    Header {
        name: "balls".to_owned(),
        model: presets::balls(),
        agent_slot: None,
        actions: Vec::new(),
        preprocess: Preprocess::Stretch,
        frame_period: None,
        first_action: FirstAction::Neutral,
        provenance: Provenance::default(),
    }
}

/// A model of the balls preset with untrained weights: no agent, no detector, no action.
pub(crate) fn balls() -> LoadedModel {
    let world = GatsbiWorld::new(Checkpoint::untrained(balls_header(), Device::Cpu));
    LoadedModel { world: Box::new(world), name: "balls".to_owned(), card: String::new() }
}

/// A checkpoint of it.
pub(crate) fn balls_checkpoint() -> &'static Path {
    static FILE: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    let (_, path) = FILE.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("balls.safetensors");
        Checkpoint::untrained(balls_header(), Device::Cpu).save(&path, Precision::Half).unwrap();
        (folder, path)
    });
    path
}

/// A configuration for tests: free ports, one thread.
pub(crate) fn config() -> Config {
    named("tiny")
}

/// The same with another name for the model, for tests that look at metrics, which are those of the process.
pub(crate) fn named(name: &str) -> Config {
    let any = "127.0.0.1:0".parse().unwrap();
    Config {
        checkpoints: vec![CheckpointArg {
            name: Some(name.to_owned()),
            path: checkpoint().to_owned(),
        }],
        grpc_listen: any,
        http_listen: any,
        admin_listen: any,
        workers: 2,
        threads: 1,
        ..Config::default()
    }
}

/// A configuration with another checkpoint.
pub(crate) fn other_checkpoint() -> Config {
    let path = checkpoint_of_another().to_owned();
    Config { checkpoints: vec![CheckpointArg { name: None, path }], ..config() }
}

/// A server of the models `tiny` and `balls`.
pub(crate) async fn serving_both() -> TestServer {
    TestServer::serving(config(), |config| {
        let mut models = app::load(config)?;
        models.push(balls());
        Ok(models)
    })
    .await
}

impl TestServer {
    pub(crate) async fn start() -> Self {
        Self::with(config()).await
    }

    pub(crate) async fn with(config: Config) -> Self {
        Self::serving(config, app::load).await
    }

    /// A server whose model stands behind another one.
    pub(crate) async fn behind(
        config: Config,
        wrap: impl FnOnce(Box<dyn WorldModel>) -> Box<dyn WorldModel> + Send + 'static,
    ) -> Self {
        Self::serving(config, |config| {
            let mut models = app::load(config)?;
            let LoadedModel { world, name, card } = models.remove(0);
            Ok(vec![LoadedModel { world: wrap(world), name, card }])
        })
        .await
    }

    pub(crate) async fn serving(
        config: Config,
        load: impl FnOnce(&Config) -> Result<Vec<LoadedModel>, app::StartError> + Send + 'static,
    ) -> Self {
        let app = App::start(config, load).await.unwrap();
        let channel = Channel::from_shared(format!("http://{}", app.grpc)).unwrap();
        let channel = channel.connect().await.unwrap();
        let most = 64 << 20;
        Self {
            models: ModelServiceClient::new(channel.clone()),
            sessions: SessionServiceClient::new(channel.clone()).max_encoding_message_size(most),
            planning: PlanningServiceClient::new(channel.clone()),
            imagination: ImaginationServiceClient::new(channel).max_encoding_message_size(most),
            http: reqwest::Client::new(),
            app,
        }
    }

    pub(crate) fn get(&self, path: &str) -> reqwest::RequestBuilder {
        self.http.get(format!("http://{}{path}", self.app.http))
    }

    pub(crate) fn post(&self, path: &str) -> reqwest::RequestBuilder {
        self.http.post(format!("http://{}{path}", self.app.http))
    }

    pub(crate) fn put(&self, path: &str) -> reqwest::RequestBuilder {
        self.http.put(format!("http://{}{path}", self.app.http))
    }

    pub(crate) fn delete(&self, path: &str) -> reqwest::RequestBuilder {
        self.http.delete(format!("http://{}{path}", self.app.http))
    }

    pub(crate) async fn admin(&self, path: &str) -> reqwest::Response {
        self.http.get(format!("http://{}{path}", self.app.admin)).send().await.unwrap()
    }

    /// Opens a session with a seed.
    pub(crate) async fn session(&self, seed: u64) -> v1::Session {
        let request = v1::CreateSessionRequest { seed: Some(seed), ..Default::default() };
        self.sessions.clone().create_session(request).await.unwrap().into_inner().session.unwrap()
    }

    /// Opens a session of a model.
    pub(crate) async fn session_on(&self, model: &str, seed: u64) -> v1::Session {
        let model = model.to_owned();
        let request = v1::CreateSessionRequest { model, seed: Some(seed), ..Default::default() };
        self.sessions.clone().create_session(request).await.unwrap().into_inner().session.unwrap()
    }

    pub(crate) async fn next_step(&self, session: &v1::Session) -> u64 {
        let request = v1::GetSessionRequest { session_id: session.id.clone() };
        let answer = self.sessions.clone().get_session(request).await.unwrap();
        answer.into_inner().session.unwrap().next_step
    }

    pub(crate) async fn observe(
        &self,
        request: v1::ObserveRequest,
    ) -> Result<v1::Belief, tonic::Status> {
        let answer = self.sessions.clone().observe(request).await?;
        Ok(answer.into_inner().belief.unwrap())
    }

    /// A session that has observed `steps` made-up steps.
    pub(crate) async fn seasoned(&self, seed: u64, steps: u64) -> v1::Session {
        let session = self.session(seed).await;
        for step in 0..steps {
            self.observe(observation(&session, step)).await.unwrap();
        }
        session
    }

    /// All chunks of a rollout.
    pub(crate) async fn imagine(
        &self,
        request: v1::ImagineRequest,
    ) -> Result<Vec<v1::RolloutChunk>, tonic::Status> {
        let mut chunks = Vec::new();
        let mut answers = self.imagination.clone().imagine(request).await?.into_inner();
        while let Some(answer) = answers.message().await? {
            chunks.push(answer.chunk.unwrap());
        }
        Ok(chunks)
    }

    /// The value of a metric, 0 where it was never counted; `labelled` is its name with its labels.
    pub(crate) async fn metric(&self, labelled: &str) -> f64 {
        let metrics = self.admin("/metrics").await.text().await.unwrap();
        let line = metrics.lines().find_map(|line| line.strip_prefix(labelled));
        line.map_or(0.0, |value| value.trim().parse().unwrap())
    }

    pub(crate) async fn post_json(&self, path: &str, body: &Json) -> (u16, Json) {
        let response = self.post(path).json(body).send().await.unwrap();
        let status = response.status().as_u16();
        (status, response.json().await.unwrap())
    }
}

/// A made-up picture, different for every step and seed: `[64, 64, 3]`.
pub(crate) fn picture(seed: u64, step: u64) -> Vec<u8> {
    let phase = seed as f64 * 0.7 + step as f64;
    let wave = |i: u32| ((f64::from(i) * 0.013 + phase).sin() * 0.5 + 0.5) * 255.0;
    (0..64 * 64 * 3).map(|i| wave(i) as u8).collect()
}

pub(crate) fn u8_image(height: u32, width: u32, data: Vec<u8>) -> v1::Image {
    let pixels = v1::Tensor {
        dtype: v1::DataType::U8.into(),
        shape: vec![height, width, 3],
        data: data.into(),
        values: Vec::new(),
    };
    v1::Image { content: Some(Content::Pixels(pixels)) }
}

pub(crate) fn f32_tensor(shape: &[u32], values: &[f32]) -> v1::Tensor {
    v1::Tensor {
        dtype: v1::DataType::F32.into(),
        shape: shape.to_vec(),
        data: values.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>().into(),
        values: Vec::new(),
    }
}

pub(crate) fn outputs(outputs: &[v1::Output], encoding: v1::Encoding) -> v1::OutputSelection {
    v1::OutputSelection {
        outputs: outputs.iter().map(|output| (*output).into()).collect(),
        encoding: encoding.into(),
        ..Default::default()
    }
}

/// The made-up observation of a step: image, action, and objects and frame wanted.
pub(crate) fn observation(session: &v1::Session, step: u64) -> v1::ObserveRequest {
    v1::ObserveRequest {
        session_id: session.id.clone(),
        observation: Some(v1::Observation {
            step: Some(step),
            image: Some(u8_image(64, 64, picture(session.seed, step))),
            action: actions(1, 1, step),
        }),
        outputs: Some(outputs(&[v1::Output::Frame, v1::Output::Objects], v1::Encoding::U8)),
        timeout_millis: None,
    }
}

/// Made-up actions, `[candidates, horizon, ACTION]`.
pub(crate) fn actions(candidates: usize, horizon: usize, phase: u64) -> Vec<f32> {
    let count = candidates * horizon * ACTION;
    (0..count).map(|i| (i as f32 * 0.37 + phase as f32).sin()).collect()
}

/// A rollout with made-up actions, of which the frames are wanted.
pub(crate) fn rollout(
    session: &v1::Session,
    candidates: usize,
    horizon: usize,
) -> v1::ImagineRequest {
    let shape = [candidates as u32, horizon as u32, ACTION as u32];
    v1::ImagineRequest {
        session_id: session.id.clone(),
        actions: Some(f32_tensor(&shape, &actions(candidates, horizon, 3))),
        sampling: Some(v1::Sampling { seed: Some(11), ..Default::default() }),
        outputs: Some(outputs(&[v1::Output::Frame], v1::Encoding::U8)),
        ..Default::default()
    }
}

/// The tensor of an output.
pub(crate) fn tensor(outputs: &[v1::OutputValue], output: v1::Output) -> &v1::Tensor {
    let value = outputs.iter().find(|value| value.output() == output);
    match value.and_then(|value| value.value.as_ref()) {
        Some(Value::Tensor(tensor)) => tensor,
        other => panic!("{output:?} is {other:?}"),
    }
}

pub(crate) fn floats(tensor: &v1::Tensor) -> Vec<f32> {
    assert_eq!(tensor.dtype(), v1::DataType::F32);
    let (numbers, rest) = tensor.data.as_chunks::<4>();
    assert!(rest.is_empty());
    numbers.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}
