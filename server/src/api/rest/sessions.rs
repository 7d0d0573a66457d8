//! Paths of sessions.

use std::sync::Arc;

use axum::{
    extract::{
        FromRequest as _, Multipart, Path, Query, Request, State, rejection::QueryRejection,
    },
    http::{StatusCode, header},
    response::{IntoResponse as _, Response},
};
use gatsbi_proto::v1;
use serde::Deserialize;

use super::{
    App, answer,
    body::{Accept, In, OCTETS, bytes, limit, malformed, media_type},
    name_session,
};
use crate::{
    api::{call::Of, form},
    error::Error,
    service::Service,
};

pub(super) async fn create(
    State(service): App,
    accept: Accept,
    body: Result<In<v1::CreateSessionRequest>, Error>,
) -> Result<Response, Error> {
    let answer = answer("CreateSession", async { service.create_session(body?.0) }).await?;
    Ok((StatusCode::CREATED, accept.answer(&answer)).into_response())
}

pub(super) async fn one(
    State(service): App,
    Path(session_id): Path<String>,
    accept: Accept,
) -> Result<Response, Error> {
    let request = v1::GetSessionRequest { session_id };
    let answer = answer("GetSession", async { service.get_session(&request) }).await?;
    Ok(accept.answer(&answer))
}

/// A page of a list, as query parameters, which are named like the message's fields.
#[expect(clippy::struct_field_names, reason = "these are the names of the message")]
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Page {
    page_size: Option<u32>,
    #[serde(default)]
    page_token: String,
    #[serde(default)]
    label: String,
}

pub(super) async fn list(
    State(service): App,
    page: Result<Query<Page>, QueryRejection>,
    accept: Accept,
) -> Result<Response, Error> {
    let answer = answer("ListSessions", async {
        let Query(Page { page_size, page_token, label }) =
            page.map_err(|error| query("ListSessionsRequest", &error))?;
        service.list_sessions(&v1::ListSessionsRequest { page_size, page_token, label })
    });
    Ok(accept.answer(&answer.await?))
}

pub(super) async fn delete(
    State(service): App,
    Path(session_id): Path<String>,
    accept: Accept,
) -> Result<Response, Error> {
    let request = v1::DeleteSessionRequest { session_id };
    let answer = answer("DeleteSession", async { service.delete_session(&request) }).await?;
    Ok(accept.answer(&answer))
}

pub(super) async fn observe(
    State(service): App,
    Path(id): Path<String>,
    accept: Accept,
    Of(call): Of,
    request: Request,
) -> Result<Response, Error> {
    let answer = answer("Observe", async {
        let mut request = if media_type(request.headers()) == "multipart/form-data" {
            let form = Multipart::from_request(request, &()).await;
            let form = form.map_err(|error| malformed::<v1::ObserveRequest>(&error.body_text()))?;
            form::observation(form).await.map_err(|error| match error {
                form::FormError::TooLarge => Error::TooLarge { limit_bytes: limit(&service) },
                form::FormError::Wrong(error) => error,
            })?
        } else {
            In::<v1::ObserveRequest>::from_request(request, &service).await?.0
        };
        name_session(&mut request.session_id, id)?;
        service.observe(request, call).await
    });
    Ok(accept.answer(&answer.await?))
}

pub(super) async fn fork(
    State(service): App,
    Path(id): Path<String>,
    accept: Accept,
    body: Result<In<v1::ForkSessionRequest>, Error>,
) -> Result<Response, Error> {
    let answer = answer("ForkSession", async {
        let mut request = body?.0;
        name_session(&mut request.session_id, id)?;
        service.fork_session(request)
    });
    Ok((StatusCode::CREATED, accept.answer(&answer.await?)).into_response())
}

pub(super) async fn rewind(
    State(service): App,
    Path(id): Path<String>,
    accept: Accept,
    body: Result<In<v1::RewindSessionRequest>, Error>,
) -> Result<Response, Error> {
    let answer = answer("RewindSession", async {
        let mut request = body?.0;
        name_session(&mut request.session_id, id)?;
        service.rewind_session(request).await
    });
    Ok(accept.answer(&answer.await?))
}

/// Which belief is wanted, as query parameters.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct At {
    at_step: Option<u64>,
}

/// The snapshot with what is told about its session, or its bytes alone (application/octet-stream).
pub(super) async fn export(
    State(service): App,
    Path(session_id): Path<String>,
    at: Result<Query<At>, QueryRejection>,
    accept: Accept,
) -> Result<Response, Error> {
    let answer = answer("ExportSession", async {
        let Query(At { at_step }) = at.map_err(|error| query("ExportSessionRequest", &error))?;
        service.export_session(&v1::ExportSessionRequest { session_id, at_step })
    });
    let answer = answer.await?;
    if accept.0 == OCTETS {
        return Ok(([(header::CONTENT_TYPE, OCTETS)], answer.snapshot).into_response());
    }
    Ok(accept.answer(&answer))
}

/// A snapshot into a session that is open.
pub(super) async fn replace(
    State(service): App,
    Path(id): Path<String>,
    accept: Accept,
    request: Request,
) -> Result<Response, Error> {
    let answer = answer("ImportSession", async {
        let mut request = snapshot(&service, request).await?;
        name_session(&mut request.session_id, id)?;
        service.import_session(request).await
    });
    Ok(accept.answer(&answer.await?))
}

/// A snapshot as a new session.
pub(super) async fn import(
    State(service): App,
    accept: Accept,
    request: Request,
) -> Result<Response, Error> {
    let answer = answer("ImportSession", async {
        let request = snapshot(&service, request).await?;
        if !request.session_id.is_empty() {
            let expected = "absent: PUT /v1/sessions/{id}/snapshot replaces a belief";
            return Err(Error::invalid("session_id", "given", expected));
        }
        service.import_session(request).await
    });
    Ok((StatusCode::CREATED, accept.answer(&answer.await?)).into_response())
}

/// A message with a snapshot, or the bytes of one alone.
async fn snapshot(
    service: &Arc<Service>,
    request: Request,
) -> Result<v1::ImportSessionRequest, Error> {
    if media_type(request.headers()) != OCTETS {
        return Ok(In::from_request(request, service).await?.0);
    }
    let snapshot = bytes::<v1::ImportSessionRequest>(request, limit(service)).await?;
    Ok(v1::ImportSessionRequest { snapshot, ..Default::default() })
}

fn query(message: &str, rejection: &QueryRejection) -> Error {
    Error::Malformed { message: message.to_owned(), reason: rejection.body_text() }
}
