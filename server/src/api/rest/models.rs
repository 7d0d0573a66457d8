//! Paths of models.

use axum::{
    extract::{Path, State},
    response::Response,
};
use gatsbi_proto::v1;

use super::{App, answer, body::Accept};
use crate::error::Error;

pub(super) async fn list(State(service): App, accept: Accept) -> Result<Response, Error> {
    let answer = answer("ListModels", async { Ok(service.list_models()) }).await?;
    Ok(accept.answer(&answer))
}

pub(super) async fn one(
    State(service): App,
    Path(model): Path<String>,
    accept: Accept,
) -> Result<Response, Error> {
    let request = v1::GetModelRequest { model };
    let answer = answer("GetModel", async { service.get_model(&request) }).await?;
    Ok(accept.answer(&answer))
}
