//! One episode through every door: the same bytes come back.

use base64::{Engine as _, prelude::BASE64_STANDARD};
use gatsbi_client::{
    Actions, Belief, Encoding, Imagination, Numbers, Output, Rollout, Sampling, Selection, Session,
};
use gatsbi_episodes::Episode;
use serde_json::{Value, json};

use crate::{
    programs::Server,
    recording::{Told, all_known, document, episode, file, known, observation},
};

const SEED: u64 = 6;

/// Frames that are observed.
const FRAMES: usize = 5;

/// Steps that are imagined.
const HORIZON: usize = 4;

/// Frame and objects.
pub(crate) fn wanted() -> Selection {
    Selection::of([Output::Frame, Output::Objects]).encoding(Encoding::U8)
}

#[tokio::test]
async fn an_episode_is_the_same_through_every_door() {
    let (server, episode) = (Server::start(), episode());
    let unary = server.session(SEED).await;
    let mut expected = Vec::new();
    for t in 0..FRAMES {
        let belief = unary.observe(observation(&episode, t), &wanted()).await.unwrap();
        expected.push(Told::from(&belief));
    }
    assert!(expected.windows(2).all(|pair| pair[0] != pair[1]), "nothing moves");

    let streamed = server.session(SEED).await;
    assert_eq!(stream(&streamed, &episode).await, expected);

    let rest = server.session(SEED).await;
    let path = format!("/v1/sessions/{}/observations", rest.id());
    for (t, expected) in expected.iter().enumerate() {
        let (status, answer) = server.post(&path, &document(&episode, t)).await;
        assert_eq!((status, &Told::from(&answer["belief"])), (200, expected));
    }

    let typed = server.session(SEED).await;
    let (file, some) = (file(), format!("..{FRAMES}"));
    let file = file.to_str().unwrap();
    let observe = ["observe", "--json", "--session", typed.id(), "--episode", file];
    let lines = server.gatsbi(&[&observe[..], &["--frames", &some]].concat()).documents();
    assert_eq!(lines.len(), FRAMES);
    for (line, expected) in lines.iter().zip(&expected) {
        let (step, objects) = expected.in_words();
        assert_eq!((line["step"].as_u64(), &all_known(line)[..]), (Some(step), objects));
    }

    // All four believe the same, so all four imagine the same.
    let expected = imagined(&unary, &episode).await;
    assert_eq!(imagined(&streamed, &episode).await, expected);
    let (status, answer) = server
        .post(&format!("/v1/sessions/{}/rollouts", rest.id()), &rollout_document(&episode))
        .await;
    assert_eq!(status, 200, "{answer}");
    assert_eq!(frames_of(&answer), frames(&expected));
    let horizon = HORIZON.to_string();
    let imagine = ["imagine", "--json", "--session", typed.id(), "--episode", file];
    let lines = server.gatsbi(&[&imagine[..], &["--horizon", &horizon, "--seed", "9"]].concat());
    let tracks = expected.outputs.tracks().unwrap();
    let lines = lines.documents();
    assert_eq!(lines.len(), HORIZON);
    for (at, line) in lines.iter().enumerate() {
        let objects: Vec<_> = tracks.objects(&[0, 0, at]).iter().map(known).collect();
        assert_eq!((line["depth"].as_u64(), all_known(line)), (Some(at as u64 + 1), objects));
    }
    server.terminate();
    let (_, log) = server.wait().await;
    assert!(!log.contains("ERROR") && !log.contains("WARN"), "{log}");
}

/// What the stream tells of the episode's first frames, several of them on their way at once.
async fn stream(session: &Session, episode: &Episode) -> Vec<Told> {
    let mut stream = session.observe_stream(&wanted());
    for t in 0..FRAMES {
        stream.send(observation(episode, t)).await.unwrap();
    }
    let mut told = Vec::new();
    while let Some(belief) = stream.next().await {
        let belief: Belief = belief.unwrap();
        told.push(Told::from(&belief));
    }
    told
}

/// The numbers of the recorded actions that follow.
fn actions(episode: &Episode) -> Vec<f32> {
    (FRAMES - 1..FRAMES - 1 + HORIZON).flat_map(|t| episode.action(t)).copied().collect()
}

/// What the client imagines under the recorded actions.
pub(crate) async fn imagined(session: &Session, episode: &Episode) -> Rollout {
    let actions = actions(episode);
    let shape = [1, HORIZON, actions.len() / HORIZON];
    let sampling = Sampling::Sample { seed: Some(9), samples: 1, independent_candidates: false };
    let actions = Actions::new(shape, actions).unwrap();
    let imagination = Imagination { sampling, ..Imagination::of(actions, wanted()) };
    session.imagine(imagination).await.unwrap().gather().await.unwrap()
}

/// The same as the body of a request to the REST API.
fn rollout_document(episode: &Episode) -> Value {
    let actions = actions(episode);
    let data: Vec<u8> = actions.iter().flat_map(|number| number.to_le_bytes()).collect();
    json!({
        "actions": {
            "dtype": "DATA_TYPE_F32",
            "shape": [HORIZON, actions.len() / HORIZON],
            "data": BASE64_STANDARD.encode(data),
        },
        "sampling": { "seed": 9 },
        "outputs": { "outputs": ["OUTPUT_FRAME"], "encoding": "ENCODING_U8" },
    })
}

/// The frames of a rollout, depth after depth.
fn frames(rollout: &Rollout) -> Vec<u8> {
    let array = rollout.outputs.array(Output::Frame).unwrap();
    let Numbers::U8(bytes) = array.numbers() else { panic!("{array:?}") };
    bytes.clone()
}

/// The same of the chunks that REST answers with.
fn frames_of(answer: &Value) -> Vec<u8> {
    let chunks = answer["chunks"].as_array().unwrap();
    let frame = |chunk: &Value| {
        BASE64_STANDARD.decode(chunk["outputs"][0]["tensor"]["data"].as_str().unwrap()).unwrap()
    };
    chunks.iter().flat_map(frame).collect()
}
