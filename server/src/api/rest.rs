//! The REST skin: the same messages as JSON, or as protobuf for who prefers it.

use std::{convert::Infallible, sync::Arc};

use axum::{
    Router,
    body::{Body, Bytes},
    extract::{
        DefaultBodyLimit, FromRequest, FromRequestParts, Multipart, Path, Query, Request, State,
    },
    http::{HeaderMap, Method, StatusCode, Uri, header, request::Parts},
    response::{IntoResponse, Response},
    routing::{delete, get, post, put},
};
use futures_util::stream::unfold;
use gatsbi_proto::v1;
use prost::{Message, Name};
use serde::Deserialize;

use super::{
    counted::{self, CountedRollout},
    form, json,
    problem::Document,
};
use crate::{error::Error, service::Service};

const JSON: &str = "application/json";
const PROTOBUF: &str = "application/x-protobuf";
const LINES: &str = "application/x-ndjson";

type App = State<Arc<Service>>;

/// All paths.
pub fn router(service: Arc<Service>) -> Router {
    let limit = service.limits().max_request_bytes as usize;
    Router::new()
        .route("/v1/models", get(list_models))
        .route("/v1/models/{model}", get(get_model))
        .route("/v1/sessions", post(create_session).get(list_sessions))
        .route("/v1/sessions/{id}", get(get_session).delete(delete_session))
        .route("/v1/sessions/{id}/observations", post(observe))
        .route("/v1/sessions/{id}/rollouts", post(imagine))
        .route("/v1/sessions/{id}/fork", post(|| later("ForkSession", "forking sessions")))
        .route("/v1/sessions/{id}/rewind", post(|| later("RewindSession", "rewinding sessions")))
        .route(
            "/v1/sessions/{id}/snapshot",
            get(|| later("ExportSession", "exporting sessions"))
                .put(|| later("ImportSession", "importing sessions")),
        )
        .route("/v1/sessions/{id}/scores", post(|| later("Score", "scoring")))
        .route("/v1/sessions/{id}/plans", post(|| later("Plan", "planning")))
        .route("/v1/predictions", post(|| later("PredictBatch", "batched predictions")))
        .route("/v1/goals", put(|| later("PutGoal", "goals")))
        .route("/v1/goals/{id}", delete(|| later("DeleteGoal", "goals")))
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

/// A part of the API that is designed and not there yet.
pub(super) async fn later(method: &'static str, what: &'static str) -> Error {
    let answer = self::answer::<()>(method, async { Err(Error::Unimplemented { what }) }).await;
    answer.err().unwrap_or(Error::Unimplemented { what })
}

async fn list_models(State(service): App, accept: Accept) -> Result<Response, Error> {
    let answer = self::answer("ListModels", async { Ok(service.list_models()) }).await?;
    Ok(accept.answer(&answer))
}

async fn get_model(
    State(service): App,
    Path(model): Path<String>,
    accept: Accept,
) -> Result<Response, Error> {
    let request = v1::GetModelRequest { model };
    let answer = self::answer("GetModel", async { service.get_model(&request) }).await?;
    Ok(accept.answer(&answer))
}

async fn create_session(
    State(service): App,
    accept: Accept,
    body: Result<In<v1::CreateSessionRequest>, Error>,
) -> Result<Response, Error> {
    let answer = self::answer("CreateSession", async { service.create_session(body?.0) }).await?;
    Ok((StatusCode::CREATED, accept.answer(&answer)).into_response())
}

async fn get_session(
    State(service): App,
    Path(session_id): Path<String>,
    accept: Accept,
) -> Result<Response, Error> {
    let request = v1::GetSessionRequest { session_id };
    let answer = self::answer("GetSession", async { service.get_session(&request) }).await?;
    Ok(accept.answer(&answer))
}

/// A page of a list, as query parameters, which are named like the message's fields.
#[expect(clippy::struct_field_names, reason = "these are the names of the message")]
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Page {
    page_size: Option<u32>,
    #[serde(default)]
    page_token: String,
    #[serde(default)]
    label: String,
}

async fn list_sessions(
    State(service): App,
    page: Result<Query<Page>, axum::extract::rejection::QueryRejection>,
    accept: Accept,
) -> Result<Response, Error> {
    let answer = self::answer("ListSessions", async {
        let Query(Page { page_size, page_token, label }) = page.map_err(|error| {
            let message = "ListSessionsRequest".to_owned();
            Error::Malformed { message, reason: error.body_text() }
        })?;
        service.list_sessions(&v1::ListSessionsRequest { page_size, page_token, label })
    });
    Ok(accept.answer(&answer.await?))
}

async fn delete_session(
    State(service): App,
    Path(session_id): Path<String>,
    accept: Accept,
) -> Result<Response, Error> {
    let request = v1::DeleteSessionRequest { session_id };
    let answer = self::answer("DeleteSession", async { service.delete_session(&request) }).await?;
    Ok(accept.answer(&answer))
}

async fn observe(
    State(service): App,
    Path(id): Path<String>,
    accept: Accept,
    request: Request,
) -> Result<Response, Error> {
    let answer = self::answer("Observe", async {
        let mut request = if media_type(request.headers()) == "multipart/form-data" {
            let form = Multipart::from_request(request, &()).await;
            let form = form.map_err(|error| malformed::<v1::ObserveRequest>(&error.body_text()))?;
            form::observation(form).await.map_err(|error| match error {
                form::FormError::TooLarge => too_large(&service),
                form::FormError::Wrong(error) => error,
            })?
        } else {
            In::<v1::ObserveRequest>::from_request(request, &service).await?.0
        };
        name_session(&mut request.session_id, id)?;
        service.observe(request, None).await
    });
    Ok(accept.answer(&answer.await?))
}

async fn imagine(
    State(service): App,
    Path(id): Path<String>,
    accept: Accept,
    body: Result<In<v1::ImagineRequest>, Error>,
) -> Result<Response, Error> {
    let start = async {
        let mut request = body?.0;
        name_session(&mut request.session_id, id)?;
        service.imagine(request, None).await
    };
    let rollout = counted::rollout("rest", start).await?;
    if accept.0 == JSON { whole(rollout).await } else { Ok(lines(rollout)) }
}

/// All chunks in one document.
async fn whole(mut rollout: CountedRollout) -> Result<Response, Error> {
    let mut text = b"{\"chunks\":[".to_vec();
    while let Some(answer) = rollout.next().await {
        if !text.ends_with(b"[") {
            text.push(b',');
        }
        text.extend(json::encode(&answer?.chunk.unwrap_or_default()));
    }
    text.extend(b"]}");
    Ok(([(header::CONTENT_TYPE, JSON)], text).into_response())
}

/// A chunk a line, as they come. An error on the way is the last line: `{"problem": ...}`.
fn lines(rollout: CountedRollout) -> Response {
    let lines = unfold(rollout, |mut rollout| async {
        let mut line = match rollout.next().await? {
            Ok(answer) => json::encode(&answer),
            Err(error) => {
                serde_json::json!({ "problem": Document::from(&error) }).to_string().into_bytes()
            }
        };
        line.push(b'\n');
        Some((Ok::<_, Infallible>(Bytes::from(line)), rollout))
    });
    ([(header::CONTENT_TYPE, LINES)], Body::from_stream(lines)).into_response()
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

/// A message in the body, JSON or protobuf.
struct In<M>(M);

impl<M: Message + Name + Default> FromRequest<Arc<Service>> for In<M> {
    type Rejection = Error;

    async fn from_request(request: Request, service: &Arc<Service>) -> Result<Self, Error> {
        let media = media_type(request.headers());
        let body = Bytes::from_request(request, service).await;
        let body = body.map_err(|error| match error.status() {
            StatusCode::PAYLOAD_TOO_LARGE => too_large(service),
            _ => malformed::<M>(&error.body_text()),
        })?;
        match media.as_str() {
            _ if body.is_empty() => Ok(Self(M::default())),
            "" | JSON => json::decode(&body).map(Self),
            PROTOBUF | "application/protobuf" => {
                M::decode(body).map(Self).map_err(|error| malformed::<M>(&error))
            }
            _ => {
                let expected = "application/json or application/x-protobuf";
                Err(Error::MediaType { found: media, expected })
            }
        }
    }
}

/// In which form the client wants its answer.
struct Accept(&'static str);

impl<S: Sync> FromRequestParts<S> for Accept {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        let accept = parts.headers.get(header::ACCEPT).and_then(|accept| accept.to_str().ok());
        let names = |media: &str| accept.is_some_and(|accept| accept.contains(media));
        Ok(Self(match () {
            () if names(PROTOBUF) => PROTOBUF,
            () if names(JSON) => JSON,
            () => "",
        }))
    }
}

impl Accept {
    fn answer<M: Message + Name>(&self, message: &M) -> Response {
        if self.0 == PROTOBUF {
            return ([(header::CONTENT_TYPE, PROTOBUF)], message.encode_to_vec()).into_response();
        }
        ([(header::CONTENT_TYPE, JSON)], json::encode(message)).into_response()
    }
}

async fn answer<T>(
    method: &'static str,
    answer: impl Future<Output = Result<T, Error>>,
) -> Result<T, Error> {
    counted::answer("rest", method, answer).await
}

/// The content type without its parameters, lower case; empty if there is none.
fn media_type(headers: &HeaderMap) -> String {
    let content = headers.get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok());
    let media = content.and_then(|content| content.split(';').next()).unwrap_or("");
    media.trim().to_ascii_lowercase()
}

fn too_large(service: &Service) -> Error {
    Error::TooLarge { limit_bytes: service.limits().max_request_bytes as usize }
}

fn malformed<M: Name>(reason: &dyn std::fmt::Display) -> Error {
    Error::Malformed { message: M::NAME.to_owned(), reason: reason.to_string() }
}
