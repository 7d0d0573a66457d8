//! A model, and the use cases over it, without a connection in between.

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, bail};
use gatsbi_models::{
    gatsbi::world::GatsbiWorld,
    noise::{PhiloxNoise, RowNoise},
    scene::{Output, Outputs},
    state::State,
    world_model::WorldModel,
};
use gatsbi_proto::v1::{self, image::Content};
use gatsbi_server::{
    app,
    config::{CheckpointArg, Config},
    engine::Engine,
    service::{Call, Service},
};
use tch::{Device, Kind, Tensor};
use tokio_util::sync::CancellationToken;

/// Forks of one session that are open at once.
const FORKS: usize = 1000;

/// Measures what a line asks for; returns its numbers.
pub(crate) fn measure(line: &str) -> Result<String> {
    let words: Vec<&str> = line.split(' ').collect();
    let seconds = |text: &str| Ok::<_, anyhow::Error>(Duration::from_secs_f64(text.parse()?));
    match words[..] {
        ["imagine", checkpoint, candidates, horizon, time] => {
            let (candidates, horizon) = (candidates.parse()?, horizon.parse()?);
            Ok(imagine(Path::new(checkpoint), candidates, horizon, seconds(time)?)?.to_string())
        }
        ["fork", checkpoint, time] => {
            let (micros, bytes) = fork(Path::new(checkpoint), seconds(time)?)?;
            Ok(format!("{micros} {bytes}"))
        }
        _ => bail!("{line:?} is nothing to measure"),
    }
}

/// Steps of rows a second on one thread, when rollouts from one belief are computed one after the other and the
/// objects of every step brought to the host.
fn imagine(checkpoint: &Path, candidates: i64, horizon: i64, time: Duration) -> Result<f64> {
    tch::set_num_threads(1);
    let _no_grad = tch::no_grad_guard();
    let world = GatsbiWorld::load(checkpoint, Device::Cpu)?;
    let (size, width) = (world.spec().image_size, world.spec().actions.len() as i64);
    let frame = Tensor::rand([1, 3, size, size], (Kind::Float, Device::Cpu));
    let action = Tensor::zeros([1, width], (Kind::Float, Device::Cpu));
    let noise = PhiloxNoise::mean(1, Device::Cpu);
    let start = world.initial_state(1);
    let (start, _) = world.observe(&start, Some(&frame), &action, &noise, Outputs::default());
    let actions = Tensor::randn([horizon, candidates, width], (Kind::Float, Device::Cpu));
    let every = Tensor::zeros(candidates, (Kind::Int64, Device::Cpu));
    let objects: Outputs = [Output::Objects].into_iter().collect();
    let (mut began, mut made) = (Instant::now(), -1);
    while made <= 0 || began.elapsed() < time {
        let mut state: State = start.gather(&every);
        for depth in 0..horizon {
            let row = RowNoise::Sample { seed: 1, sample: 0, step: 1 + depth as u64 };
            let noise = PhiloxNoise::new(vec![row; candidates as usize], Device::Cpu);
            let step = world.imagine(&state, &actions.select(0, depth), &noise, objects);
            let table = step.1.objects.context("no objects")?;
            let _ids = Vec::<i64>::try_from(table.ids.reshape([-1]))?;
            let _values = Vec::<f32>::try_from(table.values.reshape([-1]))?;
            state = step.0;
        }
        made += 1;
        if made == 0 {
            // The first was to be warm.
            began = Instant::now();
        }
    }
    Ok((made * candidates * horizon) as f64 / began.elapsed().as_secs_f64())
}

/// Microseconds of a fork of a session that has observed, and the bytes of that session.
fn fork(checkpoint: &Path, time: Duration) -> Result<(f64, u64)> {
    let checkpoints = vec![CheckpointArg { name: None, path: PathBuf::from(checkpoint) }];
    let config = Config { checkpoints, threads: 1, ..Config::default() };
    let (engine, thread) = Engine::start(config.engine())?;
    let models = app::load(&config)?.into_iter().map(|model| engine.serve(model));
    let models = models.collect::<Result<_, _>>()?;
    let service = Service::new(engine, models, &config, CancellationToken::new());
    let session_id = observed(&service)?;
    let request = v1::ForkSessionRequest { session_id: session_id.clone(), ..Default::default() };
    let (began, mut spent, mut forks) = (Instant::now(), Duration::ZERO, 0);
    while forks == 0 || began.elapsed() < time {
        let turn = Instant::now();
        let mut opened = Vec::with_capacity(FORKS);
        for _ in 0..FORKS {
            opened.extend(service.fork_session(request.clone())?.sessions);
        }
        spent += turn.elapsed();
        forks += FORKS;
        for fork in opened {
            service.delete_session(&v1::DeleteSessionRequest { session_id: fork.id })?;
        }
    }
    let told = service.get_session(&v1::GetSessionRequest { session_id })?;
    let bytes = told.session.context("no session")?.bytes;
    drop(service);
    if thread.join().is_err() {
        bail!("the model's thread has ended by a panic");
    }
    Ok((1e6 * spent.as_secs_f64() / forks as f64, bytes))
}

/// A session that has observed two frames, objects asked for.
fn observed(service: &Service) -> Result<String> {
    let opened = service.create_session(v1::CreateSessionRequest::default())?;
    let id = opened.session.context("no session")?.id;
    let models = service.list_models();
    let model = models.models.first().context("no model")?;
    let (side, actions) = (model.image_size, model.actions.len());
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    for step in 0..2 {
        let pixels = v1::Tensor {
            dtype: v1::DataType::U8.into(),
            shape: vec![side, side, 3],
            data: vec![100; (3 * side * side) as usize].into(),
            values: Vec::new(),
        };
        let request = v1::ObserveRequest {
            session_id: id.clone(),
            observation: Some(v1::Observation {
                step: Some(step),
                image: Some(v1::Image { content: Some(Content::Pixels(pixels)) }),
                action: vec![0.1; actions],
            }),
            outputs: Some(v1::OutputSelection {
                outputs: vec![v1::Output::Objects.into()],
                ..Default::default()
            }),
            timeout_millis: None,
        };
        runtime.block_on(service.observe(request, Call::default()))?;
    }
    Ok(id)
}
