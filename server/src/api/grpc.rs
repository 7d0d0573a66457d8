//! The gRPC skin: one line per unary method, and the streams.

mod control_loop;

use std::{pin::Pin, sync::Arc};

use futures_util::{Stream, StreamExt as _, stream::unfold};
use gatsbi_proto::v1::{
    self, imagination_service_server::ImaginationService, model_service_server::ModelService,
    planning_service_server::PlanningService, session_service_server::SessionService,
};
use tonic::{Request, Response, Status, Streaming, async_trait};

use self::control_loop::ControlLoop;
use super::{call, counted, problem};
use crate::{error::Error, service::Service};

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
        let call = call::of(request.metadata().as_ref());
        unary("Observe", self.0.observe(request.into_inner(), call)).await
    }

    type ObserveStreamStream = Answers<v1::ObserveStreamResponse>;

    async fn observe_stream(
        &self,
        request: Request<Streaming<v1::ObserveStreamRequest>>,
    ) -> Result<Response<Self::ObserveStreamStream>, Status> {
        let call = call::of(request.metadata().as_ref());
        let control_loop = ControlLoop::new(Arc::clone(&self.0), call, request.into_inner());
        let answers = unfold(control_loop, |mut control_loop| async {
            let answer = control_loop.next().await?;
            Some((answer, control_loop))
        });
        Ok(Response::new(Box::pin(answers)))
    }

    async fn fork_session(
        &self,
        request: Request<v1::ForkSessionRequest>,
    ) -> Result<Response<v1::ForkSessionResponse>, Status> {
        unary("ForkSession", async { self.0.fork_session(request.into_inner()) }).await
    }

    async fn rewind_session(
        &self,
        request: Request<v1::RewindSessionRequest>,
    ) -> Result<Response<v1::RewindSessionResponse>, Status> {
        unary("RewindSession", self.0.rewind_session(request.into_inner())).await
    }

    async fn export_session(
        &self,
        request: Request<v1::ExportSessionRequest>,
    ) -> Result<Response<v1::ExportSessionResponse>, Status> {
        unary("ExportSession", async { self.0.export_session(request.get_ref()) }).await
    }

    async fn import_session(
        &self,
        request: Request<v1::ImportSessionRequest>,
    ) -> Result<Response<v1::ImportSessionResponse>, Status> {
        unary("ImportSession", self.0.import_session(request.into_inner())).await
    }
}

#[async_trait]
impl ImaginationService for Grpc {
    type ImagineStream = Answers<v1::ImagineResponse>;

    async fn imagine(
        &self,
        request: Request<v1::ImagineRequest>,
    ) -> Result<Response<Self::ImagineStream>, Status> {
        let call = call::of(request.metadata().as_ref());
        let start = self.0.imagine(request.into_inner(), call);
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
        request: Request<Streaming<v1::PredictBatchRequest>>,
    ) -> Result<Response<Self::PredictBatchStream>, Status> {
        let call = call::of(request.metadata().as_ref());
        let answers = self.0.predict_batch(request.into_inner(), call);
        let answers = answers.map(|answer| answer.map(problem::prediction));
        Ok(Response::new(Box::pin(counted::stream("grpc", "PredictBatch", answers))))
    }

    async fn open_handles(
        &self,
        request: Request<v1::OpenHandlesRequest>,
    ) -> Result<Response<v1::OpenHandlesResponse>, Status> {
        unary("OpenHandles", self.0.open_handles(request.into_inner())).await
    }

    async fn step_handles(
        &self,
        request: Request<v1::StepHandlesRequest>,
    ) -> Result<Response<v1::StepHandlesResponse>, Status> {
        let call = call::of(request.metadata().as_ref());
        unary("StepHandles", self.0.step_handles(request.into_inner(), call)).await
    }

    async fn close_handles(
        &self,
        request: Request<v1::CloseHandlesRequest>,
    ) -> Result<Response<v1::CloseHandlesResponse>, Status> {
        unary("CloseHandles", async { self.0.close_handles(request.get_ref()) }).await
    }
}

#[async_trait]
impl PlanningService for Grpc {
    async fn score(
        &self,
        request: Request<v1::ScoreRequest>,
    ) -> Result<Response<v1::ScoreResponse>, Status> {
        let call = call::of(request.metadata().as_ref());
        unary("Score", self.0.score(request.into_inner(), call)).await
    }

    async fn plan(
        &self,
        request: Request<v1::PlanRequest>,
    ) -> Result<Response<v1::PlanResponse>, Status> {
        let call = call::of(request.metadata().as_ref());
        unary("Plan", self.0.find_plan(request.into_inner(), call)).await
    }

    async fn put_goal(
        &self,
        request: Request<v1::PutGoalRequest>,
    ) -> Result<Response<v1::PutGoalResponse>, Status> {
        unary("PutGoal", self.0.put_goal(request.into_inner())).await
    }

    async fn delete_goal(
        &self,
        request: Request<v1::DeleteGoalRequest>,
    ) -> Result<Response<v1::DeleteGoalResponse>, Status> {
        unary("DeleteGoal", async { self.0.delete_goal(request.get_ref()) }).await
    }
}

async fn unary<T>(
    method: &'static str,
    answer: impl Future<Output = Result<T, Error>>,
) -> Result<Response<T>, Status> {
    let answer = counted::answer("grpc", method, answer).await;
    answer.map(Response::new).map_err(|error| problem::status(&error))
}
