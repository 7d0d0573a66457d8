//! The paths of the REST API, each with the method of the wire that it is.

/// What a request carries.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Body {
    /// Nothing.
    None,
    /// The message.
    Message,
    /// The message, or a form.
    Observation,
    /// The message, or the bytes of a snapshot.
    Snapshot,
    /// A message a line.
    Lines,
}

/// A method at a path.
#[derive(Debug)]
pub(super) struct Operation {
    /// Its name in the document.
    pub(super) id: &'static str,
    pub(super) method: &'static str,
    pub(super) path: &'static str,
    /// Service and method of the wire.
    pub(super) rpc: (&'static str, &'static str),
    pub(super) body: Body,
    /// Status of an answer that is no error.
    pub(super) status: &'static str,
    /// Names, types and meanings of query parameters.
    pub(super) query: &'static [(&'static str, &'static str, &'static str)],
}

const fn operation(
    method: &'static str,
    path: &'static str,
    rpc: (&'static str, &'static str),
    body: Body,
) -> Operation {
    Operation { id: rpc.1, method, path, rpc, body, status: "200", query: &[] }
}

const fn creating(
    method: &'static str,
    path: &'static str,
    rpc: (&'static str, &'static str),
    body: Body,
) -> Operation {
    Operation { status: "201", ..operation(method, path, rpc, body) }
}

const MODELS: &str = "ModelService";
const SESSIONS: &str = "SessionService";
const IMAGINATION: &str = "ImaginationService";
const PLANNING: &str = "PlanningService";

/// All operations.
pub(super) const OPERATIONS: &[Operation] = &[
    operation("get", "/v1/models", (MODELS, "ListModels"), Body::None),
    operation("get", "/v1/models/{model}", (MODELS, "GetModel"), Body::None),
    creating("post", "/v1/sessions", (SESSIONS, "CreateSession"), Body::Message),
    Operation {
        query: &[
            ("page_size", "integer", "Sessions of a page; 100 by default."),
            ("page_token", "string", "`next_page_token` of the previous page."),
            ("label", "string", "Only sessions with this label."),
        ],
        ..operation("get", "/v1/sessions", (SESSIONS, "ListSessions"), Body::None)
    },
    operation("get", "/v1/sessions/{id}", (SESSIONS, "GetSession"), Body::None),
    operation("delete", "/v1/sessions/{id}", (SESSIONS, "DeleteSession"), Body::None),
    operation("post", "/v1/sessions/{id}/observations", (SESSIONS, "Observe"), Body::Observation),
    creating("post", "/v1/sessions/{id}/fork", (SESSIONS, "ForkSession"), Body::Message),
    operation("post", "/v1/sessions/{id}/rewind", (SESSIONS, "RewindSession"), Body::Message),
    Operation {
        query: &[("at_step", "integer", "Fails if the session's last step is another one.")],
        ..operation("get", "/v1/sessions/{id}/snapshot", (SESSIONS, "ExportSession"), Body::None)
    },
    Operation {
        id: "ReplaceSession",
        ..operation(
            "put",
            "/v1/sessions/{id}/snapshot",
            (SESSIONS, "ImportSession"),
            Body::Snapshot,
        )
    },
    creating("post", "/v1/snapshots", (SESSIONS, "ImportSession"), Body::Snapshot),
    operation("post", "/v1/sessions/{id}/rollouts", (IMAGINATION, "Imagine"), Body::Message),
    operation("post", "/v1/predictions", (IMAGINATION, "PredictBatch"), Body::Lines),
    operation("post", "/v1/sessions/{id}/scores", (PLANNING, "Score"), Body::Message),
    operation("post", "/v1/sessions/{id}/plans", (PLANNING, "Plan"), Body::Message),
    operation("put", "/v1/goals", (PLANNING, "PutGoal"), Body::Message),
    operation("delete", "/v1/goals/{id}", (PLANNING, "DeleteGoal"), Body::None),
];
