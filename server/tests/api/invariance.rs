//! The promise of reproducibility: the same request has the same bytes, alone or among any neighbours.

use std::sync::{
    Arc,
    atomic::{AtomicBool, AtomicU64, Ordering},
};

use gatsbi_proto::v1::{self, Encoding, Output};
use gatsbi_server::config::Config;

use crate::support::{TestServer, named, observation, outputs, rollout, tensor};

const EVERYTHING: [Output; 7] = [
    Output::Frame,
    Output::SlotMasks,
    Output::ObjectMasks,
    Output::Background,
    Output::Latents,
    Output::Surprise,
    Output::LogLikelihood,
];

/// What a client sees that opens a session, observes three steps, the last without an image, and imagines.
async fn told(server: &TestServer, seed: u64) -> (Vec<v1::Belief>, Vec<(u32, u32, u32, Vec<u8>)>) {
    let session = server.session(seed).await;
    let mut beliefs = Vec::new();
    for step in 0..3 {
        let mut request = observation(&session, step);
        request.outputs = Some(outputs(&EVERYTHING, Encoding::F32));
        if step == 2 {
            request.observation.as_mut().unwrap().image = None;
        }
        let belief = server.observe(request).await.unwrap();
        beliefs.push(v1::Belief { session_id: String::new(), timing: None, ..belief });
    }
    let mut request = rollout(&session, 5, 3);
    request.sampling.as_mut().unwrap().samples = Some(2);
    request.outputs = Some(outputs(&[Output::Latents, Output::Frame], Encoding::F32));
    let mut rows = Vec::new();
    for chunk in server.imagine(request).await.unwrap() {
        for output in [Output::Latents, Output::Frame] {
            let data = &tensor(&chunk.outputs, output).data;
            let row = data.len() / chunk.candidates as usize;
            for (at, row) in data.chunks_exact(row).enumerate() {
                let candidate = chunk.first_candidate + at as u32;
                rows.push((chunk.sample, candidate, chunk.depths[0], row.to_vec()));
            }
        }
    }
    rows.sort();
    (beliefs, rows)
}

/// What the requests of a test would cost if no two of them shared a block.
#[derive(Default)]
struct Apart {
    observes: AtomicU64,
    imagines: AtomicU64,
}

impl Apart {
    fn imagine(&self, rows: usize, horizon: usize, block: usize) {
        self.imagines.fetch_add((rows.div_ceil(block) * horizon) as u64, Ordering::Relaxed);
    }
}

/// Keeps the server busy with another client's work: other outputs, sizes and seeds all the time.
async fn disturb(
    server: Arc<TestServer>,
    (seed, block): (u64, usize),
    apart: Arc<Apart>,
    stop: Arc<AtomicBool>,
) {
    let mut turn = seed;
    while !stop.load(Ordering::Relaxed) {
        let session = server.session(turn).await;
        for step in 0..=turn % 3 {
            let mut request = observation(&session, step);
            let some = &EVERYTHING[..=(turn % 7) as usize];
            let encoding = [Encoding::U8, Encoding::F16, Encoding::F32][(turn % 3) as usize];
            request.outputs = Some(outputs(some, encoding));
            if step > 0 && turn.is_multiple_of(2) {
                request.observation.as_mut().unwrap().image = None;
            }
            server.observe(request).await.unwrap();
            apart.observes.fetch_add(1, Ordering::Relaxed);
        }
        let (candidates, horizon) = (1 + (turn % 4) as usize, 1 + (turn % 3) as usize);
        apart.imagine(candidates, horizon, block);
        let mut request = rollout(&session, candidates, horizon);
        request.sampling.as_mut().unwrap().seed = Some(turn * 7);
        server.imagine(request).await.unwrap();
        turn += 3;
    }
}

async fn neighbours_do_not_matter(
    name: &str,
    observe_block: usize,
    [imagine_block, wide_block]: [usize; 2],
) {
    let config = Config { observe_block, imagine_block, wide_block, ..named(name) };
    let server = Arc::new(TestServer::with(config).await);
    let alone = told(&server, 6).await;
    let (apart, stop) = (Arc::new(Apart::default()), Arc::new(AtomicBool::new(false)));
    let neighbours: Vec<_> = (0..4)
        .map(|seed| {
            let (server, apart, stop) = (server.clone(), apart.clone(), stop.clone());
            tokio::spawn(disturb(server, (seed, imagine_block), apart, stop))
        })
        .collect();
    for _ in 0..3 {
        assert!(told(&server, 6).await == alone, "blocks of {observe_block} and {imagine_block}");
    }
    stop.store(true, Ordering::Relaxed);
    for neighbour in neighbours {
        neighbour.await.unwrap();
    }
    let blocks = async |kind: &str| {
        let labels = format!("{{model=\"{name}\",kind=\"{kind}\"}}");
        server.metric(&format!("gatsbi_batch_rows_count{labels}")).await as u64
    };
    // Four times three observes and 10 rows over 3 steps were the test's own.
    let observes = apart.observes.load(Ordering::Relaxed) + 4 * 3;
    let block = if 10 < wide_block { imagine_block } else { wide_block };
    let imagines =
        apart.imagines.load(Ordering::Relaxed) + (4 * 3 * 10usize.div_ceil(block)) as u64;
    assert!(blocks("imagine").await < imagines, "no two rollouts shared a block");
    assert!(observe_block == 1 || blocks("observe").await < observes, "no two observes did");
}

#[tokio::test]
async fn neighbours_do_not_matter_in_small_blocks() {
    neighbours_do_not_matter("small", 1, [8, 32]).await;
}

#[tokio::test]
async fn neighbours_do_not_matter_in_shared_and_odd_blocks() {
    neighbours_do_not_matter("odd", 4, [5, 7]).await;
}
