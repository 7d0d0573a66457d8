//! Administration, on a listener of its own: is the process alive, is it ready, what has it counted, which models does
//! it serve.

use std::sync::Arc;

use axum::{
    Router,
    extract::{Path, Query, Request, State, rejection::QueryRejection},
    http::{StatusCode, header},
    response::{IntoResponse as _, Response},
    routing::{delete, get, post},
};
use gatsbi_proto::v1::{
    self,
    admin_service_server::{AdminService, AdminServiceServer},
};
use metrics_exporter_prometheus::PrometheusHandle;
use serde::Deserialize;
use tokio::sync::watch;
use tonic::{Status, async_trait};

use super::{
    counted, problem,
    rest::{
        self,
        body::{Accept, read},
    },
};
use crate::{error::Error, service::Service};

/// Bytes of a request.
const LIMIT: usize = 1 << 20;

/// The service, once it has started and until it goes down.
#[derive(Clone, Debug)]
struct Administration(watch::Receiver<Option<Arc<Service>>>);

impl Administration {
    fn service(&self) -> Result<Arc<Service>, Error> {
        self.0.borrow().clone().ok_or(Error::Starting)
    }
}

/// All paths, and the gRPC service beside them. Requests are answered while there is a service.
pub fn router(
    service: watch::Receiver<Option<Arc<Service>>>,
    metrics: &'static PrometheusHandle,
) -> Router {
    let administration = Administration(service);
    let text = [(header::CONTENT_TYPE, "text/plain; version=0.0.4")];
    Router::new()
        .route("/healthz", get(|| async { "alive\n" }))
        .route("/readyz", get(readiness))
        .route("/metrics", get(move || async move { (text, metrics.render()).into_response() }))
        .route("/v1/models", post(load))
        .route("/v1/models/{model}", delete(unload).put(swap))
        .route_service(
            "/gatsbi.v1.AdminService/{method}",
            AdminServiceServer::new(administration.clone()),
        )
        .fallback(rest::unknown_path)
        .method_not_allowed_fallback(rest::unknown_method)
        .with_state(administration)
}

async fn readiness(State(administration): State<Administration>) -> (StatusCode, &'static str) {
    match administration.service() {
        Ok(_) => (StatusCode::OK, "ready\n"),
        Err(_) => (StatusCode::SERVICE_UNAVAILABLE, "not ready\n"),
    }
}

async fn load(
    State(administration): State<Administration>,
    accept: Accept,
    request: Request,
) -> Result<Response, Error> {
    let answer = counted::answer("rest", "LoadModel", async {
        let request = read::<v1::LoadModelRequest>(request, LIMIT).await?;
        administration.service()?.load_model(request).await
    });
    Ok((StatusCode::CREATED, accept.answer(&answer.await?)).into_response())
}

/// How a model is unloaded, as query parameters.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct How {
    #[serde(default)]
    close_sessions: bool,
}

async fn unload(
    State(administration): State<Administration>,
    Path(model): Path<String>,
    how: Result<Query<How>, QueryRejection>,
    accept: Accept,
) -> Result<Response, Error> {
    let answer = counted::answer("rest", "UnloadModel", async {
        let Query(How { close_sessions }) = how.map_err(|error| Error::Malformed {
            message: "UnloadModelRequest".to_owned(),
            reason: error.body_text(),
        })?;
        let request = v1::UnloadModelRequest { model, close_sessions };
        administration.service()?.unload_model(request).await
    });
    Ok(accept.answer(&answer.await?))
}

async fn swap(
    State(administration): State<Administration>,
    Path(model): Path<String>,
    accept: Accept,
    request: Request,
) -> Result<Response, Error> {
    let answer = counted::answer("rest", "SwapModel", async {
        let request = read::<v1::SwapModelRequest>(request, LIMIT).await?;
        if !request.model.is_empty() && request.model != model {
            let expected = format!("absent or {model:.64}, as in the path");
            return Err(Error::invalid("model", format!("{:.64}", request.model), expected));
        }
        let request = v1::SwapModelRequest { model, ..request };
        administration.service()?.swap_model(request).await
    });
    Ok(accept.answer(&answer.await?))
}

async fn unary<T>(
    method: &'static str,
    answer: impl Future<Output = Result<T, Error>>,
) -> Result<tonic::Response<T>, Status> {
    let answer = counted::answer("grpc", method, answer).await;
    answer.map(tonic::Response::new).map_err(|error| problem::status(&error))
}

#[async_trait]
impl AdminService for Administration {
    async fn load_model(
        &self,
        request: tonic::Request<v1::LoadModelRequest>,
    ) -> Result<tonic::Response<v1::LoadModelResponse>, Status> {
        let answer = async { self.service()?.load_model(request.into_inner()).await };
        unary("LoadModel", answer).await
    }

    async fn unload_model(
        &self,
        request: tonic::Request<v1::UnloadModelRequest>,
    ) -> Result<tonic::Response<v1::UnloadModelResponse>, Status> {
        let answer = async { self.service()?.unload_model(request.into_inner()).await };
        unary("UnloadModel", answer).await
    }

    async fn swap_model(
        &self,
        request: tonic::Request<v1::SwapModelRequest>,
    ) -> Result<tonic::Response<v1::SwapModelResponse>, Status> {
        let answer = async { self.service()?.swap_model(request.into_inner()).await };
        unary("SwapModel", answer).await
    }
}
