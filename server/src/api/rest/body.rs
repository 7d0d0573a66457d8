//! Bodies: messages as JSON or protobuf, in and out.

use std::{convert::Infallible, sync::Arc};

use axum::{
    body::Bytes,
    extract::{FromRequest, FromRequestParts, Request},
    http::{HeaderMap, StatusCode, header, request::Parts},
    response::{IntoResponse, Response},
};
use prost::{Message, Name};

use crate::{api::json, error::Error, service::Service};

pub(in crate::api) const JSON: &str = "application/json";
pub(in crate::api) const PROTOBUF: &str = "application/x-protobuf";
pub(in crate::api) const LINES: &str = "application/x-ndjson";
pub(in crate::api) const OCTETS: &str = "application/octet-stream";

/// A message in the body, JSON or protobuf.
pub(in crate::api) struct In<M>(pub(in crate::api) M);

impl<M: Message + Name + Default> FromRequest<Arc<Service>> for In<M> {
    type Rejection = Error;

    async fn from_request(request: Request, service: &Arc<Service>) -> Result<Self, Error> {
        read(request, limit(service)).await.map(Self)
    }
}

/// A message in a body of at most so many bytes; none at all are the empty message.
pub(in crate::api) async fn read<M: Message + Name + Default>(
    request: Request,
    limit_bytes: usize,
) -> Result<M, Error> {
    let media = media_type(request.headers());
    let body = bytes::<M>(request, limit_bytes).await?;
    match media.as_str() {
        _ if body.is_empty() => Ok(M::default()),
        "" | JSON => json::decode(&body),
        PROTOBUF | "application/protobuf" => {
            M::decode(body).map_err(|error| malformed::<M>(&error))
        }
        _ => {
            let expected = "application/json or application/x-protobuf";
            Err(Error::MediaType { found: media, expected })
        }
    }
}

/// The bytes of a body that should be a message.
pub(in crate::api) async fn bytes<M: Name>(
    request: Request,
    limit_bytes: usize,
) -> Result<Bytes, Error> {
    let body = Bytes::from_request(request, &()).await;
    body.map_err(|error| match error.status() {
        StatusCode::PAYLOAD_TOO_LARGE => Error::TooLarge { limit_bytes },
        _ => malformed::<M>(&error.body_text()),
    })
}

/// In which form the client wants its answer.
pub(in crate::api) struct Accept(pub(in crate::api) &'static str);

impl<S: Sync> FromRequestParts<S> for Accept {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        let accept = parts.headers.get(header::ACCEPT).and_then(|accept| accept.to_str().ok());
        let names = |media: &str| accept.is_some_and(|accept| accept.contains(media));
        Ok(Self(match () {
            () if names(PROTOBUF) => PROTOBUF,
            () if names(OCTETS) => OCTETS,
            () if names(JSON) => JSON,
            () => "",
        }))
    }
}

impl Accept {
    pub(in crate::api) fn answer<M: Message + Name>(&self, message: &M) -> Response {
        if self.0 == PROTOBUF {
            return ([(header::CONTENT_TYPE, PROTOBUF)], message.encode_to_vec()).into_response();
        }
        ([(header::CONTENT_TYPE, JSON)], json::encode(message)).into_response()
    }
}

/// The content type without its parameters, lower case; empty if there is none.
pub(in crate::api) fn media_type(headers: &HeaderMap) -> String {
    let content = headers.get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok());
    let media = content.and_then(|content| content.split(';').next()).unwrap_or("");
    media.trim().to_ascii_lowercase()
}

/// Bytes that a request may have.
pub(in crate::api) fn limit(service: &Service) -> usize {
    service.limits().max_request_bytes as usize
}

pub(in crate::api) fn malformed<M: Name>(reason: &dyn std::fmt::Display) -> Error {
    Error::Malformed { message: M::NAME.to_owned(), reason: reason.to_string() }
}
