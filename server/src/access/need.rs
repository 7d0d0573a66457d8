//! Which role a method needs. What nobody has thought of needs the highest one.

use axum::http::{Method, Uri};

use super::key::Role;

/// What a request needs to be let in.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Need {
    /// Nothing: it tells nobody anything.
    Nothing,
    /// A key with this role or a higher one.
    Role(Role),
}

/// Methods of the services of `gatsbi.v1` that need no more than to look or to work.
pub const METHODS: &[(&str, Role)] = &[
    ("ModelService/ListModels", Role::Read),
    ("ModelService/GetModel", Role::Read),
    ("SessionService/GetSession", Role::Read),
    ("SessionService/ListSessions", Role::Read),
    ("SessionService/ExportSession", Role::Read),
    ("SessionService/CreateSession", Role::Predict),
    ("SessionService/DeleteSession", Role::Predict),
    ("SessionService/Observe", Role::Predict),
    ("SessionService/ObserveStream", Role::Predict),
    ("SessionService/ForkSession", Role::Predict),
    ("SessionService/RewindSession", Role::Predict),
    ("SessionService/ImportSession", Role::Predict),
    ("ImaginationService/Imagine", Role::Predict),
    ("ImaginationService/PredictBatch", Role::Predict),
    ("ImaginationService/OpenHandles", Role::Predict),
    ("ImaginationService/StepHandles", Role::Predict),
    ("ImaginationService/CloseHandles", Role::Predict),
    ("PlanningService/Score", Role::Predict),
    ("PlanningService/Plan", Role::Predict),
    ("PlanningService/PutGoal", Role::Predict),
    ("PlanningService/DeleteGoal", Role::Predict),
    ("AdminService/LoadModel", Role::Admin),
    ("AdminService/UnloadModel", Role::Admin),
    ("AdminService/SwapModel", Role::Admin),
];

/// What a gRPC method needs.
pub fn grpc(_: &Method, uri: &Uri) -> Need {
    let path = uri.path().strip_prefix('/').unwrap_or_default();
    if path.starts_with("grpc.health.v1.Health/") {
        return Need::Nothing;
    }
    if path.starts_with("grpc.reflection.v1.ServerReflection/") {
        return Need::Role(Role::Read);
    }
    let method = path.strip_prefix("gatsbi.v1.").unwrap_or_default();
    let known = METHODS.iter().find(|(name, _)| *name == method);
    Need::Role(known.map_or(Role::Admin, |(_, role)| *role))
}

/// What a path of the REST API needs: who only gets, looks; but rollouts are work, however they are asked for. The live
/// page and the description of the API are anybody's: they hold nothing, and ask with the key that they are given.
pub fn rest(method: &Method, uri: &Uri) -> Need {
    let (path, gets) = (uri.path(), [Method::GET, Method::HEAD].contains(method));
    let anybodys = ["/", "/docs", "/openapi.json"].contains(&path)
        || ["/docs/", "/page/"].iter().any(|folder| path.starts_with(folder));
    if anybodys && gets {
        return Need::Nothing;
    }
    let looks = gets && !path.contains("/rollout");
    Need::Role(if looks { Role::Read } else { Role::Predict })
}

/// What a path of administration needs; whether metrics are open is the operator's choice.
pub fn admin(open_metrics: bool) -> impl Fn(&Method, &Uri) -> Need + Clone {
    move |method, uri| match uri.path() {
        "/healthz" | "/readyz" => Need::Nothing,
        "/metrics" if open_metrics && method == Method::GET => Need::Nothing,
        _ => Need::Role(Role::Admin),
    }
}
