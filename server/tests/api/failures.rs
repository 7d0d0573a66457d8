//! A model that fails: it fails the request that it fails on, and nobody else.

use gatsbi_models::{
    noise::Noise,
    scene::{Outputs, Scene},
    state::{State, StateLayout},
    world_model::{ModelSpec, WorldModel},
};
use gatsbi_proto::v1;
use gatsbi_server::config::Config;
use tch::{Device, Tensor};
use tonic::Code;

use crate::support::{TestServer, config, named, observation, rollout};

/// First number of an action that makes the model panic.
const PANIC: f32 = 666.0;

/// First number of an action from which the model computes NaN.
const NAN: f32 = 777.0;

/// A real model that fails on certain actions.
struct Faulty(Box<dyn WorldModel>);

impl Faulty {
    fn spoiled(action: &Tensor, state: State) -> State {
        let first = action.select(1, 0);
        assert!(first.eq(f64::from(PANIC)).any().int64_value(&[]) == 0, "the model was made to");
        let nan = first.eq(f64::from(NAN)).unsqueeze(1);
        State { floats: state.floats.masked_fill(&nan, f64::NAN), ints: state.ints }
    }
}

impl WorldModel for Faulty {
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
        let (state, scene) = self.0.observe(state, frame, action, noise, wanted);
        (Self::spoiled(action, state), scene)
    }

    fn imagine(
        &self,
        state: &State,
        action: &Tensor,
        noise: &dyn Noise,
        wanted: Outputs,
    ) -> (State, Scene) {
        let (state, scene) = self.0.imagine(state, action, noise, wanted);
        (Self::spoiled(action, state), scene)
    }
}

fn spoil(mut request: v1::ObserveRequest, number: f32) -> v1::ObserveRequest {
    request.observation.as_mut().unwrap().action[0] = number;
    request
}

#[tokio::test]
async fn a_failing_observation_fails_alone() {
    let config = Config { observe_block: 4, ..named("faulty") };
    let server = TestServer::behind(config, |world| Box::new(Faulty(world))).await;
    let sessions = [server.session(0).await, server.session(1).await, server.session(2).await];
    let [good, panicking, nan] = &sessions;
    let expected = {
        let twin = server.session(0).await;
        server.observe(observation(&twin, 0)).await.unwrap()
    };
    // Sent together so that they meet in a block; whether they do or not, the answers are these.
    for _ in 0..3 {
        let (good, panicked, not_finite) = tokio::join!(
            server.observe(observation(good, 0)),
            server.observe(spoil(observation(panicking, 0), PANIC)),
            server.observe(spoil(observation(nan, 0), NAN)),
        );
        assert_eq!(good.unwrap().outputs, expected.outputs);
        let panicked = panicked.unwrap_err();
        assert_eq!(panicked.code(), Code::Internal);
        assert_eq!(panicked.message(), "the model failed on this request");
        let not_finite = not_finite.unwrap_err();
        assert_eq!(not_finite.code(), Code::Internal);
        assert!(not_finite.message().contains("not finite"));
    }
    for session in [panicking, nan] {
        assert_eq!(server.next_step(session).await, 0);
        server.observe(observation(session, 0)).await.unwrap();
    }
    for failure in ["panicked", "not_finite"] {
        let labels = format!("{{model=\"faulty\",failure=\"{failure}\"}}");
        let count = server.metric(&format!("gatsbi_model_failures_total{labels}")).await;
        assert!((count - 3.0).abs() < 1e-9, "{failure}: {count}");
    }
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_failing_rollout_fails_alone() {
    let server = TestServer::behind(config(), |world| Box::new(Faulty(world))).await;
    let session = server.seasoned(4, 1).await;
    let expected = server.imagine(rollout(&session, 4, 6)).await.unwrap();
    let spoiled = |number: f32| {
        let mut request = rollout(&session, 2, 4);
        // Candidate 1 fails at depth 3.
        let mut numbers = crate::support::actions(2, 4, 3);
        numbers[(4 + 2) * crate::support::ACTION] = number;
        request.actions = Some(crate::support::f32_tensor(&[2, 4, 7], &numbers));
        request.sampling.as_mut().unwrap().seed = Some(15);
        request
    };
    let (good, panicked, not_finite) = tokio::join!(
        server.imagine(rollout(&session, 4, 6)),
        server.imagine(spoiled(PANIC)),
        server.imagine(spoiled(NAN)),
    );
    let frames = |chunks: &[v1::RolloutChunk]| {
        let mut frames: Vec<_> = chunks
            .iter()
            .map(|chunk| (chunk.first_candidate, chunk.depths.clone(), chunk.outputs.clone()))
            .collect();
        frames.sort_by_key(|(candidate, depths, _)| (*candidate, depths.clone()));
        frames
    };
    assert_eq!(frames(&good.unwrap()), frames(&expected));
    assert_eq!(panicked.unwrap_err().code(), Code::Internal);
    assert_eq!(not_finite.unwrap_err().code(), Code::Internal);
    // The rows of the failed ones are free, and the session is where it was.
    assert_eq!(frames(&server.imagine(rollout(&session, 4, 6)).await.unwrap()), frames(&expected));
    assert_eq!(server.next_step(&session).await, 1);
    server.app.shutdown().await;
}
