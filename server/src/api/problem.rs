//! The one error table: how each [`Error`] looks on gRPC and on REST.
//!
//! gRPC gets a status with google.rpc details (`ErrorInfo`, `BadRequest`, `RetryInfo`), REST an
//! `application/problem+json` document (RFC 9457), streams a `Problem` message; all from the same [`entry`].

use std::collections::HashMap;

use axum::{
    http::{HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use gatsbi_proto::v1::{self, predict_batch_response};
use serde::Serialize;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt as _};

use crate::{
    error::{Error, FieldProblem},
    service::predict::Prediction,
};

/// The namespace of reasons, in `google.rpc.ErrorInfo`.
const DOMAIN: &str = "gatsbi";

/// How a kind of error looks on the wire.
#[derive(Clone, Copy, Debug)]
pub struct Entry {
    /// Its stable name.
    pub reason: &'static str,
    /// Status on gRPC.
    pub code: Code,
    /// Status on REST.
    pub http: StatusCode,
}

/// The table.
pub fn entry(error: &Error) -> Entry {
    let (reason, code, http) = match error {
        Error::InvalidFields(_) => {
            ("INVALID_FIELDS", Code::InvalidArgument, StatusCode::BAD_REQUEST)
        }
        Error::Malformed { .. } => {
            ("MALFORMED_BODY", Code::InvalidArgument, StatusCode::BAD_REQUEST)
        }
        Error::MediaType { .. } => {
            ("MEDIA_TYPE", Code::InvalidArgument, StatusCode::UNSUPPORTED_MEDIA_TYPE)
        }
        Error::TooLarge { .. } => {
            ("BODY_TOO_LARGE", Code::OutOfRange, StatusCode::PAYLOAD_TOO_LARGE)
        }
        Error::NoKey => ("NO_KEY", Code::Unauthenticated, StatusCode::UNAUTHORIZED),
        Error::WrongKey => ("WRONG_KEY", Code::Unauthenticated, StatusCode::UNAUTHORIZED),
        Error::ExpiredKey => ("EXPIRED_KEY", Code::Unauthenticated, StatusCode::UNAUTHORIZED),
        Error::RoleTooLow { .. } => ("ROLE_TOO_LOW", Code::PermissionDenied, StatusCode::FORBIDDEN),
        Error::QuotaExceeded { .. } => {
            ("QUOTA_EXCEEDED", Code::ResourceExhausted, StatusCode::TOO_MANY_REQUESTS)
        }
        Error::UnknownSession { .. } => ("UNKNOWN_SESSION", Code::NotFound, StatusCode::NOT_FOUND),
        Error::UnknownModel { .. } => ("UNKNOWN_MODEL", Code::NotFound, StatusCode::NOT_FOUND),
        Error::UnknownHandles { .. } => ("UNKNOWN_HANDLES", Code::NotFound, StatusCode::NOT_FOUND),
        Error::UnknownGoal { .. } => ("UNKNOWN_GOAL", Code::NotFound, StatusCode::NOT_FOUND),
        Error::HandlesMoved { .. } => {
            ("HANDLES_MOVED", Code::FailedPrecondition, StatusCode::CONFLICT)
        }
        Error::BadCheckpoint { .. } => {
            ("BAD_CHECKPOINT", Code::InvalidArgument, StatusCode::BAD_REQUEST)
        }
        Error::ModelExists { .. } => ("MODEL_EXISTS", Code::AlreadyExists, StatusCode::CONFLICT),
        Error::ModelInUse { .. } => {
            ("MODEL_IN_USE", Code::FailedPrecondition, StatusCode::CONFLICT)
        }
        Error::UnknownPath { .. } => ("UNKNOWN_PATH", Code::NotFound, StatusCode::NOT_FOUND),
        Error::UnknownMethod { .. } => {
            ("UNKNOWN_METHOD", Code::Unimplemented, StatusCode::METHOD_NOT_ALLOWED)
        }
        Error::StepConflict { .. } => ("STEP_CONFLICT", Code::AlreadyExists, StatusCode::CONFLICT),
        Error::StepGap { .. } => ("STEP_GAP", Code::FailedPrecondition, StatusCode::CONFLICT),
        Error::SessionMoved { .. } => {
            ("SESSION_MOVED", Code::FailedPrecondition, StatusCode::CONFLICT)
        }
        Error::StepNotKept { .. } => {
            ("STEP_NOT_KEPT", Code::FailedPrecondition, StatusCode::CONFLICT)
        }
        Error::ForeignSnapshot { .. } => {
            ("FOREIGN_SNAPSHOT", Code::FailedPrecondition, StatusCode::CONFLICT)
        }
        Error::NothingToShow { .. } => {
            ("NOTHING_TO_SHOW", Code::FailedPrecondition, StatusCode::CONFLICT)
        }
        Error::NothingObserved => {
            ("NOTHING_OBSERVED", Code::FailedPrecondition, StatusCode::CONFLICT)
        }
        Error::OutputUnavailable { .. } => {
            ("OUTPUT_UNAVAILABLE", Code::FailedPrecondition, StatusCode::BAD_REQUEST)
        }
        Error::Overloaded { .. } => {
            ("OVERLOADED", Code::ResourceExhausted, StatusCode::TOO_MANY_REQUESTS)
        }
        Error::TooSlow { .. } => ("TOO_SLOW", Code::DeadlineExceeded, StatusCode::GATEWAY_TIMEOUT),
        Error::TooMuchKept { .. } => {
            ("TOO_MUCH_KEPT", Code::ResourceExhausted, StatusCode::TOO_MANY_REQUESTS)
        }
        Error::TooManySessions { .. } => {
            ("TOO_MANY_SESSIONS", Code::ResourceExhausted, StatusCode::TOO_MANY_REQUESTS)
        }
        Error::DeadlineExceeded => {
            ("DEADLINE_EXCEEDED", Code::DeadlineExceeded, StatusCode::GATEWAY_TIMEOUT)
        }
        Error::Unimplemented { .. } => {
            ("UNIMPLEMENTED", Code::Unimplemented, StatusCode::NOT_IMPLEMENTED)
        }
        Error::ModelFailed => ("MODEL_FAILED", Code::Internal, StatusCode::INTERNAL_SERVER_ERROR),
        Error::NotFinite => ("NOT_FINITE", Code::Internal, StatusCode::INTERNAL_SERVER_ERROR),
        Error::Starting => ("STARTING", Code::Unavailable, StatusCode::SERVICE_UNAVAILABLE),
        Error::ShuttingDown => {
            ("SHUTTING_DOWN", Code::Unavailable, StatusCode::SERVICE_UNAVAILABLE)
        }
    };
    Entry { reason, code, http }
}

/// An error as a gRPC status.
pub fn status(error: &Error) -> Status {
    let Entry { reason, code, .. } = entry(error);
    let mut metadata = HashMap::new();
    if let Error::StepGap { expected, .. } = error {
        metadata.insert("expected_step".to_owned(), expected.to_string());
    }
    let mut details = ErrorDetails::new();
    details.set_error_info(reason, DOMAIN, metadata);
    for FieldProblem { field, value, expected } in error.fields() {
        details.add_bad_request_violation(field, format!("is {value}, expected {expected}"));
    }
    if let Some(delay) = error.retry_after() {
        details.set_retry_info(Some(delay));
    }
    Status::with_error_details(code, error.to_string(), details)
}

/// A part of the answer to one prediction of many.
pub fn prediction(prediction: Prediction) -> v1::PredictBatchResponse {
    let result = match prediction.chunk {
        Ok(chunk) => predict_batch_response::Result::Chunk(chunk),
        Err(error) => predict_batch_response::Result::Problem(message(&error)),
    };
    v1::PredictBatchResponse { key: prediction.key, result: Some(result) }
}

/// An error as a message of a stream.
pub fn message(error: &Error) -> v1::Problem {
    let Entry { reason, code, .. } = entry(error);
    let field =
        |FieldProblem { field, value, expected }| v1::FieldProblem { field, value, expected };
    v1::Problem {
        code: code as i32,
        reason: reason.to_owned(),
        message: error.to_string(),
        fields: error.fields().into_iter().map(field).collect(),
        retry_after_millis: error.retry_after().map(|delay| delay.as_millis().max(1) as u32),
    }
}

/// An error as a problem document.
#[derive(Debug, Serialize)]
pub struct Document {
    /// Names the kind of problem.
    r#type: String,
    title: &'static str,
    status: u16,
    detail: String,
    reason: &'static str,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    fields: Vec<Field>,
    #[serde(skip_serializing_if = "Option::is_none")]
    expected_step: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    retry_after_millis: Option<u64>,
}

#[derive(Debug, Serialize)]
#[expect(clippy::struct_field_names, reason = "these are the names on the wire")]
struct Field {
    field: String,
    value: String,
    expected: String,
}

impl From<&Error> for Document {
    fn from(error: &Error) -> Self {
        let Entry { reason, http, .. } = entry(error);
        let field = |FieldProblem { field, value, expected }| Field { field, value, expected };
        let expected_step = match error {
            Error::StepGap { expected, .. } => Some(*expected),
            _ => None,
        };
        Self {
            r#type: format!("urn:gatsbi:problem:{}", reason.to_lowercase().replace('_', "-")),
            title: http.canonical_reason().unwrap_or("Error"),
            status: http.as_u16(),
            detail: error.to_string(),
            reason,
            fields: error.fields().into_iter().map(field).collect(),
            expected_step,
            retry_after_millis: error.retry_after().map(|delay| delay.as_millis().max(1) as u64),
        }
    }
}

impl IntoResponse for Error {
    fn into_response(self) -> Response {
        let document = Document::from(&self);
        let body = serde_json::to_vec(&document).expect("plain data serialises");
        let media = HeaderValue::from_static("application/problem+json");
        let mut response =
            (entry(&self).http, [(header::CONTENT_TYPE, media)], body).into_response();
        if let Some(delay) = self.retry_after() {
            let seconds = HeaderValue::from(delay.as_millis().div_ceil(1000).max(1) as u64);
            response.headers_mut().insert(header::RETRY_AFTER, seconds);
        }
        response
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    /// One error of each kind.
    fn examples() -> Vec<Error> {
        let retry_after = Duration::from_millis(250);
        vec![
            Error::invalid("observation.action", "6 numbers", "7 numbers"),
            Error::Malformed { message: "ObserveRequest".into(), reason: "EOF".into() },
            Error::MediaType { found: "text/html".into(), expected: "application/json" },
            Error::TooLarge { limit_bytes: 1024 },
            Error::NoKey,
            Error::WrongKey,
            Error::ExpiredKey,
            Error::RoleTooLow { role: "read", needs: "predict" },
            Error::QuotaExceeded { what: "open sessions", limit: 3 },
            Error::QuotaExceeded { what: "rows of rollouts under way", limit: 64 },
            Error::UnknownSession { id: "7".into() },
            Error::UnknownModel { name: "x".into(), served: vec!["tiny".into()] },
            Error::UnknownHandles { id: "7".into() },
            Error::UnknownGoal { id: "7".into() },
            Error::HandlesMoved { step: 3, stepped: 5 },
            Error::BadCheckpoint { path: "x".into(), reason: "it is no checkpoint".into() },
            Error::ModelExists { name: "tiny".into() },
            Error::ModelInUse { name: "tiny".into(), sessions: 3 },
            Error::UnknownPath { path: "/v2".into() },
            Error::UnknownMethod { path: "/v1/models".into(), method: "PUT".into() },
            Error::StepConflict { step: 4 },
            Error::StepGap { step: 9, expected: 5 },
            Error::SessionMoved { at_step: 3, last: 4 },
            Error::StepNotKept { to_step: 2, oldest: Some(5), last: 9 },
            Error::StepNotKept { to_step: 2, oldest: None, last: 9 },
            Error::ForeignSnapshot {
                field: "snapshot".into(),
                found: "00ff".into(),
                expected: "which is not served here".into(),
            },
            Error::NothingToShow { last: 9 },
            Error::NothingObserved,
            Error::OutputUnavailable {
                field: "outputs.outputs[0]".into(),
                output: "OUTPUT_KEYPOINTS",
                reason: "the model has no detector",
            },
            Error::Overloaded { what: "rows of rollouts wait", retry_after },
            Error::TooSlow {
                needs: Duration::from_millis(4200),
                within: Duration::from_millis(500),
                retry_after: None,
            },
            Error::TooMuchKept { limit_bytes: 1024, retry_after },
            Error::TooManySessions { limit: 2, retry_after },
            Error::DeadlineExceeded,
            Error::Unimplemented { what: "forking" },
            Error::ModelFailed,
            Error::NotFinite,
            Error::Starting,
            Error::ShuttingDown,
        ]
    }

    #[test]
    fn the_table_is_as_agreed() {
        let lines: Vec<String> = examples()
            .iter()
            .map(|error| {
                let Entry { reason, code, http } = entry(error);
                let retry = if error.retry_after().is_some() { "retry" } else { "" };
                let code = format!("{code:?}");
                let line = format!("{reason:<20}{code:<20}{:<5}{retry:<6}{error}", http.as_u16());
                line.trim_end().to_owned()
            })
            .collect();
        insta::assert_snapshot!(lines.join("\n"));
    }

    #[test]
    fn both_apis_say_the_same() {
        for error in examples() {
            let status = status(&error);
            let details = status.get_error_details();
            let document = serde_json::to_value(Document::from(&error)).unwrap();
            assert_eq!(status.message(), document["detail"]);
            assert_eq!(details.error_info().unwrap().reason, document["reason"]);
            let violations = details.bad_request().map_or(0, |bad| bad.field_violations.len());
            assert_eq!(violations, document["fields"].as_array().map_or(0, Vec::len));
            assert_eq!(message(&error).code, status.code() as i32);
        }
    }
}
