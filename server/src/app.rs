//! The running server: listeners, the engine behind them, and an orderly end.

use std::{
    net::SocketAddr,
    sync::Arc,
    time::{Duration, Instant},
};

use axum::serve::ListenerExt as _;
use gatsbi_models::checkpoint::CheckpointError;
use gatsbi_proto::v1::{
    FILE_DESCRIPTOR_SET,
    imagination_service_server::{self, ImaginationServiceServer},
    model_service_server::{self, ModelServiceServer},
    planning_service_server::{self, PlanningServiceServer},
    session_service_server::{self, SessionServiceServer},
};
use tokio::{net::TcpListener, sync::watch, task::JoinSet};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::transport::{Server, server::TcpIncoming};

use crate::{
    api::{admin, grpc::Grpc, rest},
    checkpoints::Checkpoints,
    config::Config,
    engine::{Engine, EngineError, models::LoadedModel},
    error::told,
    service::Service,
    telemetry,
};

/// A running server.
#[derive(Debug)]
pub struct App {
    /// Where gRPC listens.
    pub grpc: SocketAddr,
    /// Where REST listens.
    pub http: SocketAddr,
    /// Where administration listens.
    pub admin: SocketAddr,
    stop: CancellationToken,
    ready: watch::Sender<Option<Arc<Service>>>,
    tasks: JoinSet<Result<(), String>>,
    engine_ended: watch::Receiver<bool>,
    drain: Duration,
}

/// The server does not start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// The configuration cannot be used.
    #[error("the configuration cannot be used: {}", .0.join("; "))]
    Config(Vec<String>),
    /// A checkpoint cannot be loaded.
    #[error("a checkpoint cannot be loaded")]
    Checkpoint(#[from] CheckpointError),
    /// The folder of checkpoints cannot be read.
    #[error("the folder of checkpoints cannot be read")]
    Folder(#[source] std::io::Error),
    /// Two models have the same name.
    #[error("two models are called {0}; NAME=PATH gives them names")]
    SameName(String),
    /// An address cannot be listened on.
    #[error("{address} cannot be listened on")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// The engine does not start.
    #[error("the engine does not start")]
    Engine(#[from] EngineError),
    /// The start itself was cut off.
    #[error("the start was cut off")]
    CutOff(#[from] tokio::task::JoinError),
}

/// Loads the checkpoints that a configuration names, with the cards beside them, and those in its folder. One that is
/// named must be there; one that is found and is no good is logged and left out.
///
/// # Errors
/// If one cannot be loaded, or two have the same name.
pub fn load(config: &Config) -> Result<Vec<LoadedModel>, StartError> {
    // The first operation decides how many threads later ones have.
    tch::set_num_threads(config.engine().threads as i32);
    let mut models: Vec<LoadedModel> = Vec::new();
    let mut add = |model: LoadedModel| {
        if models.iter().any(|known| known.name == model.name) {
            return Err(StartError::SameName(model.name));
        }
        models.push(model);
        Ok(())
    };
    let named = Checkpoints { folder: None, ..config.checkpoints() };
    for checkpoint in &config.checkpoints {
        add(named.load(&checkpoint.path, checkpoint.name.as_deref())?)?;
    }
    let folder = config.checkpoints();
    for path in folder.found().map_err(StartError::Folder)? {
        match folder.load(&path, None) {
            Ok(model) => add(model)?,
            Err(error) => {
                let (error, path) = (told(&error), path.display());
                tracing::error!(%path, error, "a checkpoint is left out");
            }
        }
    }
    Ok(models)
}

impl App {
    /// Starts serving the models that `load` gives. Administration answers at once, the rest when every model has
    /// made its first steps.
    ///
    /// # Errors
    /// If the configuration, a model or an address cannot be used.
    pub async fn start(
        config: Config,
        load: impl FnOnce(&Config) -> Result<Vec<LoadedModel>, StartError> + Send + 'static,
    ) -> Result<Self, StartError> {
        let metrics = telemetry::metrics();
        let stop = CancellationToken::new();
        let (ready, readiness) = watch::channel(None);
        let mut tasks = JoinSet::new();

        let (admin, listener) = listen(config.admin_listen).await?;
        tasks.spawn(http(listener, admin::router(readiness, metrics), &stop));
        let (grpc, grpc_listener) = listen(config.grpc_listen).await?;
        let (http, http_listener) = listen(config.http_listen).await?;

        let drain = Duration::from_secs(config.drain_seconds);
        let (engine, models, thread, config) = tokio::task::spawn_blocking(move || {
            let models = load(&config)?;
            let (engine, thread) = Engine::start(config.engine())?;
            let models: Result<Vec<_>, _> =
                models.into_iter().map(|model| engine.serve(model)).collect();
            Ok::<_, StartError>((engine, models?, thread, config))
        })
        .await??;
        let (ended, engine_ended) = watch::channel(false);
        tokio::task::spawn_blocking(move || {
            if thread.join().is_err() {
                tracing::error!("the model's thread has ended by a panic of its own");
            }
            ended.send_replace(true);
        });

        let service = Arc::new(Service::new(engine, models, &config, stop.clone()));
        tasks.spawn(sweep(Arc::downgrade(&service), metrics, stop.clone()));
        tasks.spawn(self::http(http_listener, rest::router(Arc::clone(&service)), &stop));
        tasks.spawn(self::grpc(grpc_listener, Arc::clone(&service), stop.clone()));
        ready.send_replace(Some(service));
        Ok(Self { grpc, http, admin, stop, ready, tasks, engine_ended, drain })
    }

    /// Waits until the engine has ended, which it should not while the server runs.
    pub async fn engine_ended(&mut self) {
        // The sender does not go away before it has sent.
        self.engine_ended.wait_for(|ended| *ended).await.ok();
    }

    /// Ends: takes no more requests, gives those on their way the time to finish that the configuration says, and
    /// waits for the engine.
    pub async fn shutdown(mut self) {
        self.ready.send_replace(None);
        self.stop.cancel();
        let drained = async { while self.tasks.join_next().await.is_some() {} };
        if tokio::time::timeout(self.drain, drained).await.is_err() {
            tracing::warn!(seconds = self.drain.as_secs(), "requests were cut off");
            self.tasks.shutdown().await;
        }
        // Connections that outlive their server hold on to the engine; the process does not wait for them.
        tokio::time::timeout(self.drain, self.engine_ended()).await.ok();
    }
}

async fn listen(address: SocketAddr) -> Result<(SocketAddr, TcpListener), StartError> {
    let failed = |source| StartError::Listen { address, source };
    let listener = TcpListener::bind(address).await.map_err(failed)?;
    Ok((listener.local_addr().map_err(failed)?, listener))
}

fn http(
    listener: TcpListener,
    router: axum::Router,
    stop: &CancellationToken,
) -> impl Future<Output = Result<(), String>> + use<> {
    let stopped: WaitForCancellationFutureOwned = stop.clone().cancelled_owned();
    let listener = listener.tap_io(|stream| {
        // Answers are small and awaited.
        stream.set_nodelay(true).ok();
    });
    async move {
        let serving = axum::serve(listener, router).with_graceful_shutdown(stopped);
        serving.await.map_err(|error| error.to_string())
    }
}

async fn grpc(
    listener: TcpListener,
    service: Arc<Service>,
    stop: CancellationToken,
) -> Result<(), String> {
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<ModelServiceServer<Grpc>>().await;
    health.set_serving::<SessionServiceServer<Grpc>>().await;
    health.set_serving::<ImaginationServiceServer<Grpc>>().await;
    health.set_serving::<PlanningServiceServer<Grpc>>().await;
    let reflection = tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
        .with_service_name(model_service_server::SERVICE_NAME)
        .with_service_name(session_service_server::SERVICE_NAME)
        .with_service_name(imagination_service_server::SERVICE_NAME)
        .with_service_name(planning_service_server::SERVICE_NAME)
        .build_v1()
        .map_err(|error| error.to_string())?;
    let limit = service.limits().max_request_bytes as usize;
    let grpc = Grpc(service);
    let incoming = TcpIncoming::from(listener).with_nodelay(Some(true));
    Server::builder()
        // One frame of a camera should not wait for a window update.
        .initial_stream_window_size(4 << 20)
        .initial_connection_window_size(16 << 20)
        .http2_keepalive_interval(Some(Duration::from_secs(30)))
        .http2_keepalive_timeout(Some(Duration::from_secs(20)))
        .add_service(health_service)
        .add_service(reflection)
        .add_service(ModelServiceServer::new(grpc.clone()))
        .add_service(SessionServiceServer::new(grpc.clone()).max_decoding_message_size(limit))
        .add_service(ImaginationServiceServer::new(grpc.clone()).max_decoding_message_size(limit))
        .add_service(PlanningServiceServer::new(grpc).max_decoding_message_size(limit))
        .serve_with_incoming_shutdown(incoming, stop.cancelled_owned())
        .await
        .map_err(|error| error.to_string())
}

/// Every second: closes expired sessions and keeps the metrics fresh.
async fn sweep(
    service: std::sync::Weak<Service>,
    metrics: &'static metrics_exporter_prometheus::PrometheusHandle,
    stop: CancellationToken,
) -> Result<(), String> {
    let mut seconds = tokio::time::interval(Duration::from_secs(1));
    loop {
        tokio::select! {
            _ = seconds.tick() => {}
            () = stop.cancelled() => return Ok(()),
        }
        let Some(service) = service.upgrade() else { return Ok(()) };
        let (count, bytes) = service.sweep(Instant::now());
        telemetry::sessions(count, bytes);
        metrics.run_upkeep();
    }
}
