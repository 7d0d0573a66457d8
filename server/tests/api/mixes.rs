//! Load-independent answers: random mixes of requests, in random order and with others that are given up, have the
//! same bytes as each request alone.
//!
//! A script is what one client does; what it is follows from its number. Every script is run alone first, then many
//! mixes of them at once. `GATSBI_MIXES` says how many mixes (24 by default), `GATSBI_MIX_SEED` which.

use std::sync::Arc;

use gatsbi_proto::v1::{self, Encoding, Output, predict_batch_response::Result, start::From};
use gatsbi_server::config::Config;
use sha2::{Digest as _, Sha256};
use tokio::task::JoinSet;

use crate::support::{
    ACTION, TestServer, actions, f32_tensor, named, observation, outputs, picture, rollout,
    u8_image,
};

/// Scripts that there are.
const SCRIPTS: u64 = 10;

/// Numbers that follow from a seed (SplitMix64).
struct Dice(u64);

impl Dice {
    fn roll(&mut self, sides: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let x = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (x ^ (x >> 31)) % sides
    }
}

/// What a client saw: digests of answers in the order in which it asked.
#[derive(Debug, Default, Eq, PartialEq)]
struct Told(Vec<(String, String)>);

impl Told {
    fn add(&mut self, what: &str, bytes: &[u8]) {
        let digest = Sha256::digest(bytes);
        let digest: Vec<String> = digest.iter().take(8).map(|byte| format!("{byte:02x}")).collect();
        self.0.push((format!("{}: {what}", self.0.len()), digest.concat()));
    }

    fn belief(&mut self, belief: &v1::Belief) {
        let outputs = format!("{} {:?} {:?}", belief.step, belief.outputs, belief.objects);
        self.add("belief", outputs.as_bytes());
    }

    /// Chunks come in any order and in parts of any size, so rows are told.
    fn chunks(&mut self, what: &str, chunks: &[v1::RolloutChunk]) {
        let mut rows = Vec::new();
        for chunk in chunks {
            for value in &chunk.outputs {
                let Some(v1::output_value::Value::Tensor(tensor)) = &value.value else {
                    panic!("tensors were asked for")
                };
                let row = tensor.data.len() / chunk.candidates as usize;
                for (at, data) in tensor.data.chunks_exact(row).enumerate() {
                    let candidate = chunk.first_candidate + at as u32;
                    let place = (chunk.over_samples, chunk.sample, candidate);
                    rows.push((place, chunk.depths[0], value.output, data.to_vec()));
                }
            }
        }
        rows.sort();
        self.add(what, format!("{rows:?}").as_bytes());
    }
}

/// A client that works through a script.
struct Client {
    server: Arc<TestServer>,
    dice: Dice,
    told: Told,
}

impl Client {
    /// Observes the next step of a session, some without an image.
    async fn observe(&mut self, session: &v1::Session, step: u64) {
        let mut request = observation(session, step);
        let seen = request.observation.as_mut().unwrap();
        seen.image = Some(u8_image(64, 64, picture(3, step)));
        if step > 0 && self.dice.roll(4) == 0 {
            seen.image = None;
        }
        let all = [Output::Latents, Output::Frame, Output::Surprise];
        let some = &all[..=self.dice.roll(3) as usize];
        request.outputs = Some(outputs(some, Encoding::F32));
        self.told.belief(&self.server.observe(request).await.unwrap());
    }

    async fn imagine(&mut self, session: &v1::Session) {
        let (candidates, horizon) =
            (1 + self.dice.roll(6) as usize, 1 + self.dice.roll(3) as usize);
        let mut request = rollout(session, candidates, horizon);
        let samples = 1 + self.dice.roll(2) as u32;
        let sampling = request.sampling.as_mut().unwrap();
        (sampling.samples, sampling.seed) = (Some(samples), Some(self.dice.roll(1 << 40)));
        let mut wanted = vec![Output::Latents];
        if samples > 1 {
            wanted.push(Output::Spread);
        }
        request.outputs = Some(outputs(&wanted, Encoding::F32));
        let chunks = self.server.imagine(request).await.unwrap();
        self.told.chunks("rollout", &chunks);
    }

    async fn fork(&mut self, session: &v1::Session) -> v1::Session {
        let request =
            v1::ForkSessionRequest { session_id: session.id.clone(), ..Default::default() };
        let forks = self.server.sessions.clone().fork_session(request).await.unwrap();
        forks.into_inner().sessions.remove(0)
    }

    async fn carry(&mut self, session: &v1::Session) -> v1::Session {
        let request =
            v1::ExportSessionRequest { session_id: session.id.clone(), ..Default::default() };
        let exported = self.server.sessions.clone().export_session(request).await.unwrap();
        let snapshot = exported.into_inner().snapshot;
        self.told.add("snapshot", &snapshot);
        let request = v1::ImportSessionRequest { snapshot, ..Default::default() };
        let session = self.server.sessions.clone().import_session(request).await.unwrap();
        session.into_inner().session.unwrap()
    }

    async fn handles(&mut self, session: &v1::Session) {
        let start = v1::SessionStart { session_id: session.id.clone(), at_step: None };
        let request = v1::OpenHandlesRequest {
            starts: vec![v1::Start { from: Some(From::Session(start)) }; 3],
            sampling: Some(v1::Sampling { seed: Some(self.dice.roll(99)), ..Default::default() }),
            ttl: None,
        };
        let mut imagination = self.server.imagination.clone();
        let handles_id = imagination.open_handles(request).await.unwrap().into_inner().handles_id;
        for step in 0..2 {
            let restart = if step > 0 { vec![self.dice.roll(3) as u32] } else { Vec::new() };
            let request = v1::StepHandlesRequest {
                handles_id: handles_id.clone(),
                actions: Some(f32_tensor(&[3, ACTION as u32], &actions(3, 1, step))),
                outputs: Some(outputs(&[Output::Latents], Encoding::F32)),
                restart,
                ..Default::default()
            };
            let answer = imagination.step_handles(request).await.unwrap().into_inner();
            self.told.add("handles", format!("{:?}", answer.outputs).as_bytes());
        }
        imagination.close_handles(v1::CloseHandlesRequest { handles_id }).await.unwrap();
    }

    async fn predict(&mut self, session: &v1::Session) {
        let frames = [picture(3, 0), picture(3, 1)].concat();
        let pixels = v1::Tensor {
            dtype: v1::DataType::U8.into(),
            shape: vec![2, 64, 64, 3],
            data: frames.into(),
            values: Vec::new(),
        };
        let context = v1::Context {
            frames: Some(pixels),
            actions: Some(f32_tensor(&[1, ACTION as u32], &actions(1, 1, 9))),
            seed: Some(self.dice.roll(99)),
            model: String::new(),
        };
        let start = v1::SessionStart { session_id: session.id.clone(), at_step: None };
        let request = |key: u64, from: From| v1::PredictBatchRequest {
            key,
            start: Some(v1::Start { from: Some(from) }),
            actions: Some(f32_tensor(&[2, 2, ACTION as u32], &actions(2, 2, key))),
            sampling: Some(v1::Sampling { seed: Some(key), ..Default::default() }),
            outputs: Some(outputs(&[Output::Latents], Encoding::F16)),
            costs: None,
        };
        let requests = vec![request(0, From::Context(context)), request(1, From::Session(start))];
        let mut imagination = self.server.imagination.clone();
        let answers = imagination.predict_batch(tokio_stream::iter(requests)).await;
        let mut answers = answers.unwrap().into_inner();
        let mut chunks = [Vec::new(), Vec::new()];
        while let Some(answer) = answers.message().await.unwrap() {
            let Some(Result::Chunk(chunk)) = answer.result else { panic!("{answer:?}") };
            chunks[answer.key as usize].push(chunk);
        }
        for chunks in chunks {
            self.told.chunks("prediction", &chunks);
        }
    }
}

/// Works through a script.
async fn work(server: Arc<TestServer>, script: u64) -> Told {
    let mut client = Client { server, dice: Dice(script * 7919), told: Told::default() };
    let seed = client.dice.roll(1 << 40);
    let mode = if client.dice.roll(3) == 0 { v1::Mode::Mean } else { v1::Mode::Sample };
    let request = v1::CreateSessionRequest {
        seed: Some(seed),
        mode: mode.into(),
        keep_steps: 1,
        ..Default::default()
    };
    let session = client.server.sessions.clone().create_session(request).await.unwrap();
    let mut session = session.into_inner().session.unwrap();
    let mut step = 0;
    client.observe(&session, step).await;
    for _ in 0..4 {
        match client.dice.roll(7) {
            0 => client.imagine(&session).await,
            1 => session = client.fork(&session).await,
            2 => session = client.carry(&session).await,
            3 => client.handles(&session).await,
            4 => client.predict(&session).await,
            5 => {
                step += 1;
                client.observe(&session, step).await;
                let (session_id, to_step) = (session.id.clone(), Some(step - 1));
                let request = v1::RewindSessionRequest { session_id, to_step };
                client.server.sessions.clone().rewind_session(request).await.unwrap();
                step -= 1;
            }
            _ => {
                step += 1;
                client.observe(&session, step).await;
            }
        }
    }
    step += 1;
    client.observe(&session, step).await;
    client.imagine(&session).await;
    client.told
}

/// Somebody who asks for much and leaves, or has too little time.
async fn leave(server: Arc<TestServer>, mut dice: Dice) {
    let session = server.seasoned(dice.roll(99), 1).await;
    let mut request = rollout(&session, 1 + dice.roll(12) as usize, 20);
    if dice.roll(2) == 0 {
        request.timeout_millis = Some(1 + dice.roll(200) as u32);
        server.imagine(request).await.ok();
    } else if let Ok(answers) = server.imagination.clone().imagine(request).await {
        answers.into_inner().message().await.ok();
    }
    let abandoned = tokio::spawn({
        let server = Arc::clone(&server);
        async move { server.observe(observation(&session, 1)).await.is_ok() }
    });
    for _ in 0..dice.roll(200) {
        tokio::task::yield_now().await;
    }
    abandoned.abort();
}

fn setting(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().unwrap())
}

async fn mixes_do_not_matter(
    name: &str,
    observe_block: usize,
    [imagine_block, wide_block]: [usize; 2],
) {
    let config = Config { observe_block, imagine_block, wide_block, ..named(name) };
    let server = Arc::new(TestServer::with(config).await);
    let mut alone = Vec::new();
    for script in 0..SCRIPTS {
        alone.push(work(Arc::clone(&server), script).await);
    }
    let fill = async || {
        let of = async |what: &str| {
            let labels = format!("{{model=\"{name}\",kind=\"imagine\"}}");
            server.metric(&format!("gatsbi_batch_rows_{what}{labels}")).await
        };
        (of("sum").await, of("count").await)
    };
    let before = fill().await;
    for mix in 0..setting("GATSBI_MIXES", 24) / 2 {
        let seed = setting("GATSBI_MIX_SEED", 1) * 1_000_003 + mix;
        let mut dice = Dice(seed);
        let mut clients = JoinSet::new();
        for _ in 0..2 + dice.roll(4) {
            let (script, pause) = (dice.roll(SCRIPTS), dice.roll(300));
            let working = Arc::clone(&server);
            clients.spawn(async move {
                for _ in 0..pause {
                    tokio::task::yield_now().await;
                }
                Some((script, work(working, script).await))
            });
            if dice.roll(2) == 0 {
                let (server, dice) = (Arc::clone(&server), Dice(dice.roll(1 << 40)));
                clients.spawn(async move {
                    leave(server, dice).await;
                    None
                });
            }
        }
        while let Some(told) = clients.join_next().await {
            let Some((script, told)) = told.unwrap() else { continue };
            assert_eq!(told, alone[script as usize], "script {script} in mix {mix}, seed {seed}");
        }
    }
    let after = fill().await;
    let alone = before.0 / before.1;
    let mixed = (after.0 - before.0) / (after.1 - before.1);
    assert!(mixed > alone, "requests shared blocks: {mixed:.2} rows a block, {alone:.2} alone");
}

#[tokio::test]
async fn mixes_do_not_matter_in_the_usual_blocks() {
    mixes_do_not_matter("usual-mixes", 1, [8, 32]).await;
}

#[tokio::test]
async fn mixes_do_not_matter_in_shared_and_odd_blocks() {
    mixes_do_not_matter("odd-mixes", 3, [5, 7]).await;
}
