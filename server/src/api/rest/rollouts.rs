//! Paths of rollouts, plans and goals.

use std::convert::Infallible;

use axum::{
    body::{Body, Bytes},
    extract::{FromRequest as _, Path, Request, State},
    http::header,
    response::{IntoResponse as _, Response},
};
use futures_util::{
    StreamExt as _,
    stream::{iter, unfold},
};
use gatsbi_proto::v1;

use super::{
    App, answer,
    body::{Accept, In, JSON, LINES, bytes, limit, media_type},
    name_session,
};
use crate::{
    api::{
        call::Of,
        counted::{self, CountedRollout},
        json,
        problem::{self, Document},
    },
    error::Error,
};

pub(super) async fn imagine(
    State(service): App,
    Path(id): Path<String>,
    accept: Accept,
    Of(call): Of,
    body: Result<In<v1::ImagineRequest>, Error>,
) -> Result<Response, Error> {
    let start = async {
        let mut request = body?.0;
        name_session(&mut request.session_id, id)?;
        service.imagine(request, call).await
    };
    let rollout = counted::rollout("rest", start).await?;
    if accept.0 == JSON { whole(rollout).await } else { Ok(lines(rollout)) }
}

pub(super) async fn score(
    State(service): App,
    Path(id): Path<String>,
    accept: Accept,
    Of(call): Of,
    body: Result<In<v1::ScoreRequest>, Error>,
) -> Result<Response, Error> {
    let answer = answer("Score", async {
        let mut request = body?.0;
        name_session(&mut request.session_id, id)?;
        service.score(request, call).await
    });
    Ok(accept.answer(&answer.await?))
}

pub(super) async fn plan(
    State(service): App,
    Path(id): Path<String>,
    accept: Accept,
    Of(call): Of,
    body: Result<In<v1::PlanRequest>, Error>,
) -> Result<Response, Error> {
    let answer = answer("Plan", async {
        let mut request = body?.0;
        name_session(&mut request.session_id, id)?;
        service.find_plan(request, call).await
    });
    Ok(accept.answer(&answer.await?))
}

pub(super) async fn put_goal(
    State(service): App,
    accept: Accept,
    body: Result<In<v1::PutGoalRequest>, Error>,
) -> Result<Response, Error> {
    let answer = answer("PutGoal", async { service.put_goal(body?.0).await }).await?;
    Ok(accept.answer(&answer))
}

pub(super) async fn delete_goal(
    State(service): App,
    Path(goal_id): Path<String>,
    accept: Accept,
) -> Result<Response, Error> {
    let request = v1::DeleteGoalRequest { goal_id };
    let answer = answer("DeleteGoal", async { service.delete_goal(&request) }).await?;
    Ok(accept.answer(&answer))
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

/// Predictions in bulk: a request a line (application/x-ndjson), or a single one; answers a line each, as they come.
pub(super) async fn predict(
    State(service): App,
    Of(call): Of,
    request: Request,
) -> Result<Response, Error> {
    let requests: Result<Vec<v1::PredictBatchRequest>, Error> = async {
        if media_type(request.headers()) != LINES {
            return Ok(vec![
                In::<v1::PredictBatchRequest>::from_request(request, &service).await?.0,
            ]);
        }
        let body = bytes::<v1::PredictBatchRequest>(request, limit(&service)).await?;
        let lines = body.split(|byte| *byte == b'\n').filter(|line| !line.trim_ascii().is_empty());
        lines.map(json::decode).collect()
    }
    .await;
    let requests = match requests {
        Ok(requests) => iter(requests),
        Err(error) => return answer("PredictBatch", async { Err(error) }).await,
    };
    let requests = requests.map(Ok::<v1::PredictBatchRequest, Infallible>);
    let answers = service.predict_batch(requests, call).map(|answer| {
        let Ok(answer) = answer;
        let mut line = json::encode(&problem::prediction(answer));
        line.push(b'\n');
        Ok::<_, Infallible>(Bytes::from(line))
    });
    let answers = counted::stream("rest", "PredictBatch", answers);
    Ok(([(header::CONTENT_TYPE, LINES)], Body::from_stream(answers)).into_response())
}
