//! Administration, on a listener of its own: is the process alive, is it ready, what has it counted.

use axum::{
    Router,
    http::{StatusCode, header},
    response::IntoResponse,
    routing::{delete, get, post},
};
use gatsbi_proto::v1::{
    self,
    admin_service_server::{AdminService, AdminServiceServer},
};
use metrics_exporter_prometheus::PrometheusHandle;
use tokio::sync::watch;
use tonic::{Request, Response, Status, async_trait};

use super::{grpc, rest};

const LATER: &str = "loading, unloading and swapping models while the server runs";

/// All paths, and the gRPC service beside them; `ready` tells whether requests are answered.
pub fn router(ready: watch::Receiver<bool>, metrics: &'static PrometheusHandle) -> Router {
    let readiness = move || {
        let ready = *ready.borrow();
        async move {
            if ready {
                (StatusCode::OK, "ready\n")
            } else {
                (StatusCode::SERVICE_UNAVAILABLE, "not ready\n")
            }
        }
    };
    let text = [(header::CONTENT_TYPE, "text/plain; version=0.0.4")];
    Router::new()
        .route("/healthz", get(|| async { "alive\n" }))
        .route("/readyz", get(readiness))
        .route("/metrics", get(move || async move { (text, metrics.render()).into_response() }))
        .route("/v1/models", post(|| rest::later("LoadModel", LATER)))
        .route(
            "/v1/models/{model}",
            delete(|| rest::later("UnloadModel", LATER)).put(|| rest::later("SwapModel", LATER)),
        )
        .route_service("/gatsbi.v1.AdminService/{method}", AdminServiceServer::new(Administration))
        .fallback(rest::unknown_path)
        .method_not_allowed_fallback(rest::unknown_method)
}

/// The gRPC service of administration.
#[derive(Clone, Copy, Debug)]
struct Administration;

#[async_trait]
impl AdminService for Administration {
    async fn load_model(
        &self,
        _: Request<v1::LoadModelRequest>,
    ) -> Result<Response<v1::LoadModelResponse>, Status> {
        grpc::unimplemented("LoadModel", LATER).await
    }

    async fn unload_model(
        &self,
        _: Request<v1::UnloadModelRequest>,
    ) -> Result<Response<v1::UnloadModelResponse>, Status> {
        grpc::unimplemented("UnloadModel", LATER).await
    }

    async fn swap_model(
        &self,
        _: Request<v1::SwapModelRequest>,
    ) -> Result<Response<v1::SwapModelResponse>, Status> {
        grpc::unimplemented("SwapModel", LATER).await
    }
}
