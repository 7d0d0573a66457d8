//! The REST skin: the same messages as JSON, or as protobuf for who prefers it.
//!
//! [`body`] reads and writes them; the paths are a file a room: [`models`], [`sessions`], [`rollouts`], and for people
//! [`pictures`] and [`live`].

pub(super) mod body;
mod live;
mod models;
mod pictures;
mod rollouts;
mod sessions;

use std::sync::Arc;

use axum::{
    Router,
    extract::{DefaultBodyLimit, State},
    http::{Method, Uri},
    routing::{delete, get, post, put},
};

use utoipa_swagger_ui::SwaggerUi;

use super::{counted, openapi::DOCUMENT};
use crate::{dashboard, error::Error, service::Service};

type App = State<Arc<Service>>;

/// What holds nothing that is anybody's: the files of the live page, the document of the API at /openapi.json, and a
/// page over it that needs nothing from elsewhere.
pub fn open(service: &Arc<Service>) -> Router {
    Router::new()
        .merge(dashboard::routes())
        .merge(documentation())
        .fallback(unknown_path)
        .method_not_allowed_fallback(unknown_method)
        .with_state(Arc::clone(service))
}

fn documentation() -> SwaggerUi {
    SwaggerUi::new("/docs").external_url_unchecked("/openapi.json", DOCUMENT.clone())
}

/// All paths.
pub fn router(service: Arc<Service>) -> Router {
    let limit = service.limits().max_request_bytes as usize;
    Router::new()
        .route("/v1/models", get(models::list))
        .route("/v1/models/{model}", get(models::one))
        .route("/v1/sessions", post(sessions::create).get(sessions::list))
        .route("/v1/sessions/{id}", get(sessions::one).delete(sessions::delete))
        .route("/v1/sessions/{id}/observations", post(sessions::observe))
        .route("/v1/sessions/{id}/rollouts", post(rollouts::imagine))
        .route("/v1/sessions/{id}/fork", post(sessions::fork))
        .route("/v1/sessions/{id}/rewind", post(sessions::rewind))
        .route("/v1/sessions/{id}/snapshot", get(sessions::export).put(sessions::replace))
        .route("/v1/snapshots", post(sessions::import))
        .route("/v1/sessions/{id}/scores", post(rollouts::score))
        .route("/v1/sessions/{id}/plans", post(rollouts::plan))
        .route("/v1/predictions", post(rollouts::predict))
        .route("/v1/goals", put(rollouts::put_goal))
        .route("/v1/goals/{id}", delete(rollouts::delete_goal))
        .merge(pictures::routes())
        .merge(live::routes())
        .merge(dashboard::routes())
        .merge(documentation())
        .fallback(unknown_path)
        .method_not_allowed_fallback(unknown_method)
        .layer(DefaultBodyLimit::max(limit))
        .with_state(service)
}

pub(super) async fn unknown_path(uri: Uri) -> Error {
    Error::UnknownPath { path: uri.path().to_owned() }
}

pub(super) async fn unknown_method(method: Method, uri: Uri) -> Error {
    Error::UnknownMethod { path: uri.path().to_owned(), method: method.to_string() }
}

/// The session of the path is that of the message.
fn name_session(field: &mut String, id: String) -> Result<(), Error> {
    if !field.is_empty() && *field != id {
        let expected = format!("absent or {id:.64}, as in the path");
        return Err(Error::invalid("session_id", format!("{field:.64}"), expected));
    }
    *field = id;
    Ok(())
}

async fn answer<T>(
    method: &'static str,
    answer: impl Future<Output = Result<T, Error>>,
) -> Result<T, Error> {
    counted::answer("rest", method, answer).await
}
