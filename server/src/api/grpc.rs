//! The gRPC skin: one line per unary method, and the two streams.

use std::{
    pin::Pin,
    sync::Arc,
    time::{Duration, Instant},
};

use futures_util::{Stream, stream::unfold};
use gatsbi_proto::v1::{
    self, imagination_service_server::ImaginationService, model_service_server::ModelService,
    observe_stream_response, planning_service_server::PlanningService,
    session_service_server::SessionService,
};
use tonic::{Request, Response, Status, Streaming, async_trait, metadata::MetadataMap};

use super::{counted, problem};
use crate::{
    error::{Error, FieldProblem},
    service::Service,
};

/// Answers of a stream.
type Answers<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// The gRPC services.
#[derive(Clone, Debug)]
pub struct Grpc(pub Arc<Service>);

#[async_trait]
impl ModelService for Grpc {
    async fn list_models(
        &self,
        _: Request<v1::ListModelsRequest>,
    ) -> Result<Response<v1::ListModelsResponse>, Status> {
        unary("ListModels", async { Ok(self.0.list_models()) }).await
    }

    async fn get_model(
        &self,
        request: Request<v1::GetModelRequest>,
    ) -> Result<Response<v1::GetModelResponse>, Status> {
        unary("GetModel", async { self.0.get_model(request.get_ref()) }).await
    }
}

#[async_trait]
impl SessionService for Grpc {
    async fn create_session(
        &self,
        request: Request<v1::CreateSessionRequest>,
    ) -> Result<Response<v1::CreateSessionResponse>, Status> {
        unary("CreateSession", async { self.0.create_session(request.into_inner()) }).await
    }

    async fn get_session(
        &self,
        request: Request<v1::GetSessionRequest>,
    ) -> Result<Response<v1::GetSessionResponse>, Status> {
        unary("GetSession", async { self.0.get_session(request.get_ref()) }).await
    }

    async fn list_sessions(
        &self,
        request: Request<v1::ListSessionsRequest>,
    ) -> Result<Response<v1::ListSessionsResponse>, Status> {
        unary("ListSessions", async { self.0.list_sessions(request.get_ref()) }).await
    }

    async fn delete_session(
        &self,
        request: Request<v1::DeleteSessionRequest>,
    ) -> Result<Response<v1::DeleteSessionResponse>, Status> {
        unary("DeleteSession", async { self.0.delete_session(request.get_ref()) }).await
    }

    async fn observe(
        &self,
        request: Request<v1::ObserveRequest>,
    ) -> Result<Response<v1::ObserveResponse>, Status> {
        let deadline = deadline(request.metadata());
        unary("Observe", self.0.observe(request.into_inner(), deadline)).await
    }

    type ObserveStreamStream = Answers<v1::ObserveStreamResponse>;

    async fn observe_stream(
        &self,
        request: Request<Streaming<v1::ObserveStreamRequest>>,
    ) -> Result<Response<Self::ObserveStreamStream>, Status> {
        let control_loop = ControlLoop {
            service: Arc::clone(&self.0),
            observations: request.into_inner(),
            session_id: String::new(),
            outputs: None,
            ended: false,
        };
        let answers = unfold(control_loop, |mut control_loop| async {
            let answer = control_loop.next().await?;
            Some((answer, control_loop))
        });
        Ok(Response::new(Box::pin(answers)))
    }

    async fn fork_session(
        &self,
        _: Request<v1::ForkSessionRequest>,
    ) -> Result<Response<v1::ForkSessionResponse>, Status> {
        unimplemented("ForkSession", "forking sessions").await
    }

    async fn rewind_session(
        &self,
        _: Request<v1::RewindSessionRequest>,
    ) -> Result<Response<v1::RewindSessionResponse>, Status> {
        unimplemented("RewindSession", "rewinding sessions").await
    }

    async fn export_session(
        &self,
        _: Request<v1::ExportSessionRequest>,
    ) -> Result<Response<v1::ExportSessionResponse>, Status> {
        unimplemented("ExportSession", "exporting sessions").await
    }

    async fn import_session(
        &self,
        _: Request<v1::ImportSessionRequest>,
    ) -> Result<Response<v1::ImportSessionResponse>, Status> {
        unimplemented("ImportSession", "importing sessions").await
    }
}

#[async_trait]
impl ImaginationService for Grpc {
    type ImagineStream = Answers<v1::ImagineResponse>;

    async fn imagine(
        &self,
        request: Request<v1::ImagineRequest>,
    ) -> Result<Response<Self::ImagineStream>, Status> {
        let deadline = deadline(request.metadata());
        let start = self.0.imagine(request.into_inner(), deadline);
        let rollout = counted::rollout("grpc", start).await;
        let rollout = rollout.map_err(|error| problem::status(&error))?;
        let chunks = unfold(rollout, |mut rollout| async {
            let chunk = rollout.next().await?;
            Some((chunk.map_err(|error| problem::status(&error)), rollout))
        });
        Ok(Response::new(Box::pin(chunks)))
    }

    type PredictBatchStream = Answers<v1::PredictBatchResponse>;

    async fn predict_batch(
        &self,
        _: Request<Streaming<v1::PredictBatchRequest>>,
    ) -> Result<Response<Self::PredictBatchStream>, Status> {
        unimplemented("PredictBatch", "batched predictions").await
    }

    async fn open_handles(
        &self,
        _: Request<v1::OpenHandlesRequest>,
    ) -> Result<Response<v1::OpenHandlesResponse>, Status> {
        unimplemented("OpenHandles", "handles for policies outside").await
    }

    async fn step_handles(
        &self,
        _: Request<v1::StepHandlesRequest>,
    ) -> Result<Response<v1::StepHandlesResponse>, Status> {
        unimplemented("StepHandles", "handles for policies outside").await
    }

    async fn close_handles(
        &self,
        _: Request<v1::CloseHandlesRequest>,
    ) -> Result<Response<v1::CloseHandlesResponse>, Status> {
        unimplemented("CloseHandles", "handles for policies outside").await
    }
}

#[async_trait]
impl PlanningService for Grpc {
    async fn score(
        &self,
        _: Request<v1::ScoreRequest>,
    ) -> Result<Response<v1::ScoreResponse>, Status> {
        unimplemented("Score", "scoring").await
    }

    async fn plan(
        &self,
        _: Request<v1::PlanRequest>,
    ) -> Result<Response<v1::PlanResponse>, Status> {
        unimplemented("Plan", "planning").await
    }

    async fn put_goal(
        &self,
        _: Request<v1::PutGoalRequest>,
    ) -> Result<Response<v1::PutGoalResponse>, Status> {
        unimplemented("PutGoal", "goals").await
    }

    async fn delete_goal(
        &self,
        _: Request<v1::DeleteGoalRequest>,
    ) -> Result<Response<v1::DeleteGoalResponse>, Status> {
        unimplemented("DeleteGoal", "goals").await
    }
}

/// The control loop of one session.
struct ControlLoop {
    service: Arc<Service>,
    observations: Streaming<v1::ObserveStreamRequest>,
    session_id: String,
    outputs: Option<v1::OutputSelection>,
    ended: bool,
}

impl ControlLoop {
    /// Waits for an observation and answers it.
    async fn next(&mut self) -> Option<Result<v1::ObserveStreamResponse, Status>> {
        if self.ended {
            return None;
        }
        let stop = self.service.stop().clone();
        let received = tokio::select! {
            received = self.observations.message() => received,
            () = stop.cancelled() => Err(problem::status(&Error::ShuttingDown)),
        };
        let request = match received {
            Ok(request) => request?,
            Err(status) => {
                self.ended = true;
                return Some(Err(status));
            }
        };
        let answer = counted::answer("grpc", "ObserveStream", self.observe(request)).await;
        let answer = match answer {
            Ok(belief) => observe_stream_response::Result::Belief(belief),
            // Without its session the loop has nothing to go on with.
            Err(error @ Error::UnknownSession { .. }) => {
                self.ended = true;
                return Some(Err(problem::status(&error)));
            }
            Err(error) => observe_stream_response::Result::Problem(problem::message(&error)),
        };
        Some(Ok(v1::ObserveStreamResponse { result: Some(answer) }))
    }

    async fn observe(&mut self, request: v1::ObserveStreamRequest) -> Result<v1::Belief, Error> {
        let v1::ObserveStreamRequest { session_id, observation, outputs, timeout_millis } = request;
        if self.session_id.is_empty() {
            self.session_id = session_id;
        } else if !session_id.is_empty() && session_id != self.session_id {
            let expected = format!("empty or {}: a stream is for one session", self.session_id);
            let problem = FieldProblem::new("session_id", format!("{session_id:.64}"), expected);
            return Err(Error::InvalidFields(vec![problem]));
        }
        if outputs.is_some() {
            self.outputs = outputs;
        }
        let request = v1::ObserveRequest {
            session_id: self.session_id.clone(),
            observation,
            outputs: self.outputs.clone(),
            timeout_millis,
        };
        let answer = self.service.observe(request, None).await?;
        Ok(answer.belief.unwrap_or_default())
    }
}

async fn unary<T>(
    method: &'static str,
    answer: impl Future<Output = Result<T, Error>>,
) -> Result<Response<T>, Status> {
    let answer = counted::answer("grpc", method, answer).await;
    answer.map(Response::new).map_err(|error| problem::status(&error))
}

pub(super) async fn unimplemented<T>(
    method: &'static str,
    what: &'static str,
) -> Result<Response<T>, Status> {
    unary(method, async { Err(Error::Unimplemented { what }) }).await
}

/// The deadline that a call brings along: up to eight digits and a unit (gRPC over HTTP/2, `grpc-timeout`).
fn deadline(metadata: &MetadataMap) -> Option<Instant> {
    let text = metadata.get("grpc-timeout")?.to_str().ok()?;
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    let number: u64 = digits.parse().ok().filter(|_| digits.len() <= 8)?;
    let timeout = match unit {
        "H" => Duration::from_secs(number * 3600),
        "M" => Duration::from_secs(number * 60),
        "S" => Duration::from_secs(number),
        "m" => Duration::from_millis(number),
        "u" => Duration::from_micros(number),
        "n" => Duration::from_nanos(number),
        _ => return None,
    };
    Instant::now().checked_add(timeout)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deadlines_of_calls_are_understood() {
        let left = |text: &'static str| {
            let mut metadata = MetadataMap::new();
            metadata.insert("grpc-timeout", text.parse().unwrap());
            deadline(&metadata).map(|at| at.duration_since(Instant::now()))
        };
        let near = |text, seconds: f64| {
            let left = left(text).unwrap().as_secs_f64();
            assert!((seconds - 1.0..=seconds).contains(&left), "{text}: {left}");
        };
        near("5S", 5.0);
        near("2H", 7200.0);
        near("3M", 180.0);
        near("2500m", 2.5);
        near("4000000u", 4.0);
        assert!(left("10n").is_some());
        for bad in ["", "5", "S", "5s", "123456789S", "-1S"] {
            assert_eq!(left(bad), None, "{bad}");
        }
        assert_eq!(deadline(&MetadataMap::new()), None);
    }
}
