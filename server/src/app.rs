//! The running server: listeners, the engine behind them, and an orderly end.

use std::{
    net::SocketAddr,
    sync::Arc,
    time::{Duration, Instant},
};

use gatsbi_models::checkpoint::CheckpointError;
use gatsbi_proto::v1::{
    FILE_DESCRIPTOR_SET,
    imagination_service_server::{self, ImaginationServiceServer},
    model_service_server::{self, ModelServiceServer},
    planning_service_server::{self, PlanningServiceServer},
    session_service_server::{self, SessionServiceServer},
};
use tokio::{sync::watch, task::JoinSet};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};
use tonic::{service::Routes, transport::Server};

use crate::{
    access::{Access, gate::Gate, key_file::KeyFileError, need},
    api::{admin, grpc::Grpc, rest},
    checkpoints::Checkpoints,
    config::Config,
    engine::{Engine, EngineError, models::LoadedModel},
    error::told,
    listener::Listener,
    service::Service,
    telemetry,
    tls::{Tls, TlsError},
};

/// How long the engine may take to end when all requests have, or were cut off.
const ENGINE_END: Duration = Duration::from_secs(2);

/// A running server.
#[derive(Debug)]
pub struct App {
    /// Where gRPC listens.
    pub grpc: SocketAddr,
    /// Where REST listens.
    pub http: SocketAddr,
    /// Where administration listens.
    pub admin: SocketAddr,
    access: Option<Arc<Access>>,
    tls: Option<Arc<Tls>>,
    stop: CancellationToken,
    ready: watch::Sender<Option<Arc<Service>>>,
    tasks: JoinSet<Result<(), String>>,
    engine: Engine,
    engine_ended: watch::Receiver<bool>,
    drain: Duration,
}

/// The server does not start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// The configuration cannot be used.
    #[error("the configuration cannot be used: {}", .0.join("; "))]
    Config(Vec<String>),
    /// Keys cannot be used.
    #[error(transparent)]
    Keys(#[from] KeyFileError),
    /// Certificates cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
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
    /// The description of the gRPC API cannot be served.
    #[error("the description of the gRPC API cannot be served")]
    Routes(#[source] tonic_reflection::server::Error),
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
        let access = match &config.keys {
            Some(path) => Some(Arc::new(Access::load(path, config.quota())?)),
            None => None,
        };
        let tls = config.tls().map(Tls::load).transpose()?.map(Arc::new);
        if access.is_some() && tls.is_none() && config.is_public() {
            tracing::warn!(
                "keys travel in the clear: --tls-certificate and --tls-key encrypt them"
            );
        }
        let stop = CancellationToken::new();
        let (ready, readiness) = watch::channel(None);
        let mut tasks = JoinSet::new();

        let (admin, listener) = listen(config.admin_listen, tls.as_ref()).await?;
        let administration = admin::router(readiness, metrics);
        let all = administration.clone();
        let need = need::admin(config.open_metrics);
        let gate = Gate::new(access.clone(), need, administration, move |_| all.clone());
        tasks.spawn(http(listener, gate.into_router(), &stop));
        let (grpc, grpc_listener) = listen(config.grpc_listen, tls.as_ref()).await?;
        let (http, http_listener) = listen(config.http_listen, tls.as_ref()).await?;

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

        let service = Arc::new(Service::new(engine.clone(), models, &config, stop.clone()));
        let watched = (Arc::downgrade(&service), tls.clone());
        tasks.spawn(sweep(watched, metrics, stop.clone()));
        let of = Arc::clone(&service);
        let gate = Gate::new(access.clone(), need::rest, rest::open(&service), move |owner| {
            rest::router(Arc::new(of.of(owner)))
        });
        let router = gate.into_router();
        tasks.spawn(self::http(http_listener, router, &stop));
        let routes =
            routes(Arc::clone(&service), access.clone()).await.map_err(StartError::Routes)?;
        tasks.spawn(self::grpc(grpc_listener, routes, stop.clone()));
        ready.send_replace(Some(service));
        Ok(Self { grpc, http, admin, access, tls, stop, ready, tasks, engine, engine_ended, drain })
    }

    /// The keys in force, if there are any.
    pub fn access(&self) -> Option<&Access> {
        self.access.as_deref()
    }

    /// The certificates in force, if there are any.
    pub fn tls(&self) -> Option<&Tls> {
        self.tls.as_deref()
    }

    /// The service, while it serves.
    pub(crate) fn service(&self) -> Option<Arc<Service>> {
        self.ready.borrow().clone()
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
        // Connections that outlive their server hold on to the engine. It must not compute any more when the process ends:
        // libtorch's globals go first.
        let ended = async {
            self.engine.stop().await;
            self.engine_ended().await;
        };
        if tokio::time::timeout(ENGINE_END, ended).await.is_err() {
            tracing::warn!("the engine has not ended");
        }
    }
}

async fn listen(
    address: SocketAddr,
    tls: Option<&Arc<Tls>>,
) -> Result<(SocketAddr, Listener), StartError> {
    let failed = |source| StartError::Listen { address, source };
    let listener = Listener::bind(address, tls.cloned()).await.map_err(failed)?;
    Ok((axum::serve::Listener::local_addr(&listener).map_err(failed)?, listener))
}

fn http(
    listener: Listener,
    router: axum::Router,
    stop: &CancellationToken,
) -> impl Future<Output = Result<(), String>> + use<> {
    let stopped: WaitForCancellationFutureOwned = stop.clone().cancelled_owned();
    async move {
        let serving = axum::serve(listener, router).with_graceful_shutdown(stopped);
        serving.await.map_err(|error| error.to_string())
    }
}

/// The gRPC services behind their gate: health for everybody, all else over what is the tenant's own.
async fn routes(
    service: Arc<Service>,
    access: Option<Arc<Access>>,
) -> Result<axum::Router, tonic_reflection::server::Error> {
    let (reporter, health) = tonic_health::server::health_reporter();
    reporter.set_serving::<ModelServiceServer<Grpc>>().await;
    reporter.set_serving::<SessionServiceServer<Grpc>>().await;
    reporter.set_serving::<ImaginationServiceServer<Grpc>>().await;
    reporter.set_serving::<PlanningServiceServer<Grpc>>().await;
    let reflection = tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
        .with_service_name(model_service_server::SERVICE_NAME)
        .with_service_name(session_service_server::SERVICE_NAME)
        .with_service_name(imagination_service_server::SERVICE_NAME)
        .with_service_name(planning_service_server::SERVICE_NAME)
        .build_v1()?;
    let open = Routes::new(health.clone()).into_axum_router();
    let limit = service.limits().max_request_bytes as usize;
    let routes_of = move |owner| {
        let grpc = Grpc(Arc::new(service.of(owner)));
        let imagination = ImaginationServiceServer::new(grpc.clone());
        Routes::new(health.clone())
            .add_service(reflection.clone())
            .add_service(ModelServiceServer::new(grpc.clone()))
            .add_service(SessionServiceServer::new(grpc.clone()).max_decoding_message_size(limit))
            .add_service(imagination.max_decoding_message_size(limit))
            .add_service(PlanningServiceServer::new(grpc).max_decoding_message_size(limit))
            .into_axum_router()
    };
    Ok(Gate::new(access, need::grpc, open, routes_of).into_router())
}

async fn grpc(
    listener: Listener,
    routes: axum::Router,
    stop: CancellationToken,
) -> Result<(), String> {
    Server::builder()
        // One frame of a camera should not wait for a window update.
        .initial_stream_window_size(4 << 20)
        .initial_connection_window_size(16 << 20)
        .http2_keepalive_interval(Some(Duration::from_secs(30)))
        .http2_keepalive_timeout(Some(Duration::from_secs(20)))
        .add_routes(Routes::from(routes))
        .serve_with_incoming_shutdown(Box::pin(listener.into_stream()), stop.cancelled_owned())
        .await
        .map_err(|error| error.to_string())
}

/// Every second: closes expired sessions and keeps the metrics fresh.
async fn sweep(
    (service, tls): (std::sync::Weak<Service>, Option<Arc<Tls>>),
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
        if let Some(tls) = &tls {
            telemetry::certificate_ends(tls.ends());
        }
        metrics.run_upkeep();
    }
}
