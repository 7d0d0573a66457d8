//! Why a call failed, with what the server says about it.
//!
//! A failure is the caller's to mend ([`Error::Input`], most of [`Error::Refused`]) or passes ([`Error::may_pass`]).
//! What the client repeats by itself is decided in [`crate::Retries`].

use std::{fmt, time::Duration};

use gatsbi_proto::v1;
pub use tonic::Code;
use tonic::Status;
use tonic_types::StatusExt as _;

/// The namespace of the service's reasons in `google.rpc.ErrorInfo`.
const DOMAIN: &str = "gatsbi";

/// What calls return.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Why a call failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The URL is none that a server of this kind can have.
    #[error(
        "{url:?} is not the address of a server, expected http://HOST:PORT, or with TLS https://HOST:PORT"
    )]
    Address {
        /// What was given.
        url: String,
    },
    /// Nothing answers at the URL.
    #[error("no server answers at {url}")]
    Unreachable {
        /// The URL.
        url: String,
        /// Why.
        #[source]
        source: tonic::transport::Error,
    },
    /// A request that no server could take, found before it was sent.
    #[error("{field} is {value}, expected {expected}")]
    Input {
        /// Path of the field.
        field: &'static str,
        /// What was found.
        value: String,
        /// What was expected.
        expected: String,
    },
    /// The server refused the request, or failed on it, and says why.
    #[error(transparent)]
    Refused(Box<Problem>),
    /// The connection broke before the answer was there. Whether the server carried the request out is not known.
    #[error("the connection to the server broke")]
    Broken(#[source] Box<Status>),
    /// The time allowed for the call was up before the answer was there. Whether the server carried the request out is
    /// not known.
    #[error("no answer came within {} ms", .0.as_millis())]
    TimedOut(Duration),
    /// The server answered something that `gatsbi.v1` does not allow.
    #[error("the server's answer cannot be understood: {0}")]
    Answer(String),
}

/// What the server says about a request that it refused or failed on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    /// Canonical status.
    pub code: Code,
    /// Stable name, such as `STEP_GAP`; empty where something other than the service answered, such as a proxy.
    pub reason: String,
    /// One sentence for people.
    pub message: String,
    /// The fields at fault.
    pub fields: Vec<FieldProblem>,
    /// After how long trying again may help.
    pub retry_after: Option<Duration>,
}

/// What is wrong with one field.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FieldProblem {
    /// Path in the request, such as `observation.action[2]`.
    pub field: String,
    /// What was found and what was expected, such as `is 6 numbers, expected 7 numbers`.
    pub description: String,
}

impl std::error::Error for Problem {}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.message.is_empty() {
            return write!(f, "the server answered {:?}", self.code);
        }
        f.write_str(&self.message)
    }
}

impl Error {
    /// Whether the same call may succeed later: the server was not reached, is full, or is going down.
    pub fn may_pass(&self) -> bool {
        match self {
            Self::Unreachable { .. } | Self::Broken(_) | Self::TimedOut(_) => true,
            Self::Refused(problem) => {
                problem.retry_after.is_some()
                    || matches!(problem.code, Code::Unavailable | Code::DeadlineExceeded)
            }
            _ => false,
        }
    }

    /// What the server said, if it answered.
    pub fn problem(&self) -> Option<&Problem> {
        match self {
            Self::Refused(problem) => Some(problem),
            _ => None,
        }
    }

    pub(crate) fn input(
        field: &'static str,
        value: impl fmt::Display,
        expected: impl Into<String>,
    ) -> Self {
        Self::Input { field, value: value.to_string(), expected: expected.into() }
    }
}

impl From<Status> for Error {
    fn from(status: Status) -> Self {
        // Only a status that the transport made, not the server, has a cause.
        if std::error::Error::source(&status).is_some() {
            return Self::Broken(Box::new(status));
        }
        let details = status.get_error_details();
        let info = details.error_info().filter(|info| info.domain == DOMAIN);
        let violations = details.bad_request().map_or(&[][..], |bad| &bad.field_violations);
        let field = |violation: &tonic_types::FieldViolation| FieldProblem {
            field: violation.field.clone(),
            description: violation.description.clone(),
        };
        Self::Refused(Box::new(Problem {
            code: status.code(),
            reason: info.map(|info| info.reason.clone()).unwrap_or_default(),
            message: status.message().to_owned(),
            fields: violations.iter().map(field).collect(),
            retry_after: details.retry_info().and_then(|info| info.retry_delay),
        }))
    }
}

impl From<v1::Problem> for Error {
    fn from(problem: v1::Problem) -> Self {
        let field = |v1::FieldProblem { field, value, expected }| FieldProblem {
            field,
            description: format!("is {value}, expected {expected}"),
        };
        Self::Refused(Box::new(Problem {
            code: Code::from_i32(problem.code),
            reason: problem.reason,
            message: problem.message,
            fields: problem.fields.into_iter().map(field).collect(),
            retry_after: problem
                .retry_after_millis
                .map(|millis| Duration::from_millis(millis.into())),
        }))
    }
}

#[cfg(test)]
mod tests {
    use std::{collections::HashMap, io};

    use tonic_types::ErrorDetails;

    use super::*;

    #[test]
    fn details_of_a_status_are_kept() {
        let mut details = ErrorDetails::new();
        details.set_error_info("OVERLOADED", DOMAIN, HashMap::new());
        details.add_bad_request_violation("actions", "is [3], expected [3, 7]");
        details.set_retry_info(Some(Duration::from_millis(250)));
        let status = Status::with_error_details(Code::ResourceExhausted, "full", details);
        let error = Error::from(status);
        assert!(error.may_pass());
        let problem = error.problem().unwrap();
        assert_eq!(problem.reason, "OVERLOADED");
        assert_eq!(problem.retry_after, Some(Duration::from_millis(250)));
        assert_eq!(problem.fields[0].field, "actions");
        assert_eq!(problem.fields[0].description, "is [3], expected [3, 7]");
        assert_eq!(error.to_string(), "full");
    }

    #[test]
    fn a_problem_in_a_stream_reads_as_one_of_a_call() {
        let error = Error::from(v1::Problem {
            code: Code::FailedPrecondition as i32,
            reason: "STEP_GAP".into(),
            message: "step 9 does not follow".into(),
            fields: vec![v1::FieldProblem {
                field: "observation.step".into(),
                value: "9".into(),
                expected: "5".into(),
            }],
            retry_after_millis: None,
        });
        assert!(!error.may_pass());
        let problem = error.problem().unwrap();
        assert_eq!(problem.code, Code::FailedPrecondition);
        assert_eq!(problem.fields[0].description, "is 9, expected 5");
    }

    #[test]
    fn a_status_that_the_transport_made_is_a_broken_connection() {
        let cause = io::Error::from(io::ErrorKind::ConnectionReset);
        assert!(matches!(Error::from(Status::from_error(cause.into())), Error::Broken(_)));
        assert!(matches!(Error::from(Status::unknown("said by the server")), Error::Refused(_)));
    }

    #[test]
    fn a_stranger_that_answers_is_told_from_the_service() {
        let error = Error::from(Status::new(Code::Unimplemented, ""));
        assert_eq!(error.problem().unwrap().reason, "");
        assert_eq!(error.to_string(), "the server answered Unimplemented");
    }
}
