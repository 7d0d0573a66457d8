//! Why a request fails: one enumeration for all use cases, known to neither gRPC nor HTTP.
//!
//! How each failure looks on the wire is decided in one place, [`crate::api::problem`].

use std::{fmt, time::Duration};

/// What is wrong with one field of a request.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct FieldProblem {
    /// Path of the field, such as `observation.action[2]`.
    pub field: String,
    /// What was found.
    pub value: String,
    /// What was expected.
    pub expected: String,
}

impl FieldProblem {
    /// A problem with `field`, where `value` was found and `expected` should be.
    pub fn new(
        field: impl Into<String>,
        value: impl fmt::Display,
        expected: impl Into<String>,
    ) -> Self {
        Self { field: field.into(), value: value.to_string(), expected: expected.into() }
    }
}

impl fmt::Display for FieldProblem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} is {}, expected {}", self.field, self.value, self.expected)
    }
}

/// Why a request fails.
#[derive(Clone, Debug, Eq, PartialEq, thiserror::Error)]
pub enum Error {
    /// Fields that are wrong whatever the state of the server.
    #[error("{}", list(.0))]
    InvalidFields(Vec<FieldProblem>),
    /// A body that cannot be read as the message it should be.
    #[error("the request body is not a valid {message}: {reason}")]
    Malformed {
        /// Name of the message.
        message: String,
        /// What the parser says.
        reason: String,
    },
    /// A body of a type that is not understood.
    #[error("content type {found} is not understood, expected {expected}")]
    MediaType {
        /// The type.
        found: String,
        /// Those that are.
        expected: &'static str,
    },
    /// A body that is too large.
    #[error("the request body has more than {limit_bytes} bytes")]
    TooLarge {
        /// The limit.
        limit_bytes: usize,
    },
    /// A request without a key, where one is needed.
    #[error("a key is needed: Authorization: Bearer KEY")]
    NoKey,
    /// A key that nobody has.
    #[error("the key is not known")]
    WrongKey,
    /// A key that was good once.
    #[error("the key has expired")]
    ExpiredKey,
    /// A key that is not good for this.
    #[error("this needs a key with the role {needs} or a higher one, and the key's role is {role}")]
    RoleTooLow {
        /// The key's role.
        role: &'static str,
        /// The lowest that would do.
        needs: &'static str,
    },
    /// More than a tenant may take.
    #[error("this tenant may have no more than {limit} {what}")]
    QuotaExceeded {
        /// What there is too much of.
        what: &'static str,
        /// How much there may be.
        limit: u64,
    },
    /// A session that does not exist, or no longer.
    #[error("there is no session {id}")]
    UnknownSession {
        /// The id that was given.
        id: String,
    },
    /// A model that is not served.
    #[error("there is no model {name}, but {}", served.join(", "))]
    UnknownModel {
        /// The name that was given.
        name: String,
        /// Those that are served.
        served: Vec<String>,
    },
    /// Handles that do not exist, or no longer.
    #[error("there are no handles {id}")]
    UnknownHandles {
        /// The id that was given.
        id: String,
    },
    /// A goal that does not exist, or no longer.
    #[error("there is no goal {id}")]
    UnknownGoal {
        /// The id that was given.
        id: String,
    },
    /// Handles that are not where the request believes them to be, or that were stepped otherwise.
    #[error("the handles were stepped {stepped} times, not {step}")]
    HandlesMoved {
        /// What was given.
        step: u64,
        /// What is so.
        stepped: u64,
    },
    /// A checkpoint that cannot be served.
    #[error("the checkpoint {path} cannot be served: {reason}")]
    BadCheckpoint {
        /// Its path.
        path: String,
        /// Why.
        reason: String,
    },
    /// A name that another model has.
    #[error("there is a model {name} already")]
    ModelExists {
        /// The name.
        name: String,
    },
    /// A model that sessions use.
    #[error("model {name} has {sessions} sessions; close_sessions closes them")]
    ModelInUse {
        /// The name.
        name: String,
        /// How many.
        sessions: usize,
    },
    /// The server has not started yet.
    #[error("the server is starting")]
    Starting,
    /// A path that leads nowhere.
    #[error("there is nothing at {path}")]
    UnknownPath {
        /// The path.
        path: String,
    },
    /// A method that the path does not have.
    #[error("{path} does not understand {method}")]
    UnknownMethod {
        /// The path.
        path: String,
        /// The method.
        method: String,
    },
    /// A step that was observed before, with something else.
    #[error("step {step} was already observed, with another observation or selection of outputs")]
    StepConflict {
        /// The step.
        step: u64,
    },
    /// A step that is not the next one.
    #[error("step {step} does not follow, the session expects step {expected}")]
    StepGap {
        /// The step that was given.
        step: u64,
        /// The session's next one.
        expected: u64,
    },
    /// The session is not where the request believes it to be.
    #[error("the session is at step {last}, not at {at_step}")]
    SessionMoved {
        /// The step that was given.
        at_step: u64,
        /// The last step observed.
        last: u64,
    },
    /// An earlier step that the session did not keep.
    #[error("step {to_step} was not kept: {}", kept(*.oldest, *.last))]
    StepNotKept {
        /// The step that was given.
        to_step: u64,
        /// The earliest step that was kept, if any was.
        oldest: Option<u64>,
        /// The last step observed.
        last: u64,
    },
    /// A snapshot of a model that is not served, or not the session's.
    #[error("the snapshot is of checkpoint {found}, {expected}")]
    ForeignSnapshot {
        /// Path of the field.
        field: String,
        /// Hash of the snapshot's checkpoint.
        found: String,
        /// What it should be.
        expected: String,
    },
    /// A session whose last step was not observed by itself.
    #[error(
        "step {last} cannot be shown: the session was rewound or imported to it, or moved to another model"
    )]
    NothingToShow {
        /// The last step.
        last: u64,
    },
    /// A session without a belief.
    #[error("the session has observed nothing yet")]
    NothingObserved,
    /// An output that exists for no step of this kind or on no such model.
    #[error("{output} cannot be had: {reason}")]
    OutputUnavailable {
        /// Path of the field.
        field: String,
        /// The output.
        output: &'static str,
        /// Why.
        reason: &'static str,
    },
    /// More work than the server takes on.
    #[error("the server has as much work as it takes on: {what}")]
    Overloaded {
        /// Of what there is too much.
        what: &'static str,
        /// When it should have become less.
        retry_after: Duration,
    },
    /// An answer that cannot be there in time.
    #[error("the answer needs {}, the deadline is in {}", seconds(*.needs), seconds(*.within))]
    TooSlow {
        /// How long it takes, as far as is known.
        needs: Duration,
        /// When it is of no use any more.
        within: Duration,
        /// When it could be there in time, if that is only because of other work.
        retry_after: Option<Duration>,
    },
    /// More memory than the server keeps for what clients want kept.
    #[error(
        "the server keeps no more than {limit_bytes} bytes of earlier steps, frames and handles"
    )]
    TooMuchKept {
        /// The limit.
        limit_bytes: u64,
        /// When the next session expires.
        retry_after: Duration,
    },
    /// More sessions than the server keeps.
    #[error("the server keeps no more than {limit} sessions")]
    TooManySessions {
        /// The limit.
        limit: usize,
        /// When the next one expires.
        retry_after: Duration,
    },
    /// The answer would come too late.
    #[error("the deadline passed before the answer was there")]
    DeadlineExceeded,
    /// Part of the API that this version does not have.
    #[error("{what} is not available in this version")]
    Unimplemented {
        /// What.
        what: &'static str,
    },
    /// The model panicked.
    #[error("the model failed on this request")]
    ModelFailed,
    /// The model computed something that is not a number.
    #[error("the model computed numbers that are not finite for this request")]
    NotFinite,
    /// The server is going down.
    #[error("the server is shutting down")]
    ShuttingDown,
}

impl Error {
    /// One field that is wrong.
    pub fn invalid(
        field: impl Into<String>,
        value: impl fmt::Display,
        expected: impl Into<String>,
    ) -> Self {
        Self::InvalidFields(vec![FieldProblem::new(field, value, expected)])
    }

    /// The fields at fault.
    pub fn fields(&self) -> Vec<FieldProblem> {
        match self {
            Self::InvalidFields(fields) => fields.clone(),
            Self::UnknownSession { id } => {
                vec![FieldProblem::new("session_id", id, "the id of an open session")]
            }
            Self::UnknownHandles { id } => {
                vec![FieldProblem::new("handles_id", id, "the id of open handles")]
            }
            Self::UnknownGoal { id } => {
                vec![FieldProblem::new("goal_id", id, "the id of a goal that is kept")]
            }
            Self::BadCheckpoint { path, reason } => {
                let expected = format!("a checkpoint that can be served: {reason}");
                vec![FieldProblem::new("path", path, expected)]
            }
            Self::ModelExists { name } => {
                vec![FieldProblem::new("name", name, "a name that no model has")]
            }
            Self::HandlesMoved { step, stepped } => {
                vec![FieldProblem::new("step", step, stepped.to_string())]
            }
            Self::UnknownModel { name, served } => {
                let expected = format!("one of {}", served.join(", "));
                vec![FieldProblem::new("model", name, expected)]
            }
            Self::StepConflict { step } => {
                let expected = "the observation and outputs that were sent with it before";
                vec![FieldProblem::new("observation.step", step, expected)]
            }
            Self::StepGap { step, expected } => {
                vec![FieldProblem::new("observation.step", step, expected.to_string())]
            }
            Self::SessionMoved { at_step, last } => {
                vec![FieldProblem::new("at_step", at_step, last.to_string())]
            }
            Self::StepNotKept { to_step, oldest, last } => {
                vec![FieldProblem::new("to_step", to_step, kept(*oldest, *last))]
            }
            Self::ForeignSnapshot { field, found, expected } => {
                vec![FieldProblem::new(field, format!("of checkpoint {found}"), expected)]
            }
            Self::OutputUnavailable { field, output, reason } => {
                vec![FieldProblem::new(
                    field,
                    output,
                    format!("an output that can be had: {reason}"),
                )]
            }
            _ => Vec::new(),
        }
    }

    /// When trying again may help.
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Overloaded { retry_after, .. }
            | Self::TooManySessions { retry_after, .. }
            | Self::TooMuchKept { retry_after, .. } => Some(*retry_after),
            Self::TooSlow { retry_after, .. } => *retry_after,
            // Rows come back by themselves, all else when it is given back.
            Self::QuotaExceeded { what, .. } => {
                what.starts_with("rows").then_some(Duration::from_secs(1))
            }
            Self::Starting | Self::ShuttingDown => Some(Duration::from_secs(1)),
            _ => None,
        }
    }
}

/// Which steps a session can return to, in words.
fn kept(oldest: Option<u64>, last: u64) -> String {
    match oldest {
        Some(oldest) => format!("a step of {oldest} to {last}"),
        None => format!("step {last}: the session keeps no earlier ones (keep_steps)"),
    }
}

fn seconds(time: Duration) -> String {
    format!("{:.3} s", time.as_secs_f64())
}

/// An error and its causes as one sentence.
pub fn told(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(error.source(), |cause| cause.source());
    causes.fold(error.to_string(), |told, cause| format!("{told}: {cause}"))
}

fn list(fields: &[FieldProblem]) -> String {
    fields.iter().map(ToString::to_string).collect::<Vec<_>>().join("; ")
}
