//! The control loop of one session: observations in, in the same order a belief or a problem for each.
//!
//! Where the session wants it, the loop looks ahead: an image is passed over if a newer one has arrived.

use std::{collections::VecDeque, sync::Arc};

use futures_util::FutureExt as _;
use gatsbi_proto::v1::{self, observe_stream_response};
use prost::Message as _;
use tonic::{Status, Streaming};

use crate::{
    api::{counted, problem},
    error::{Error, FieldProblem},
    service::{Call, Service},
};

/// Observations that are taken from the connection before their turn, at most.
const AHEAD: usize = 64;

/// The control loop of one session.
pub(super) struct ControlLoop {
    service: Arc<Service>,
    call: Call,
    observations: Streaming<v1::ObserveStreamRequest>,
    /// Observations that have arrived, and how the stream ended, if it has.
    arrived: VecDeque<v1::ObserveStreamRequest>,
    end: Option<Result<(), Status>>,
    session_id: String,
    outputs: Option<v1::OutputSelection>,
}

impl ControlLoop {
    pub(super) fn new(
        service: Arc<Service>,
        call: Call,
        observations: Streaming<v1::ObserveStreamRequest>,
    ) -> Self {
        Self {
            service,
            // The deadline of the call is that of the whole loop, not of a step.
            call: Call { deadline: None, ..call },
            observations,
            arrived: VecDeque::new(),
            end: None,
            session_id: String::new(),
            outputs: None,
        }
    }

    /// Waits for an observation and answers it.
    pub(super) async fn next(&mut self) -> Option<Result<v1::ObserveStreamResponse, Status>> {
        if self.arrived.is_empty() && self.end.is_none() {
            let stop = self.service.stop().clone();
            let received = tokio::select! {
                received = self.observations.message() => received,
                () = stop.cancelled() => Err(problem::status(&Error::ShuttingDown)),
            };
            self.take(received);
        }
        let Some(request) = self.arrived.pop_front() else {
            return self.end.replace(Ok(()))?.err().map(Err);
        };
        let answer = counted::answer("grpc", "ObserveStream", self.observe(request)).await;
        let answer = match answer {
            Ok(belief) => observe_stream_response::Result::Belief(belief),
            // Without its session the loop has nothing to go on with.
            Err(error @ Error::UnknownSession { .. }) => {
                self.arrived.clear();
                self.end = Some(Ok(()));
                return Some(Err(problem::status(&error)));
            }
            Err(error) => observe_stream_response::Result::Problem(problem::message(&error)),
        };
        Some(Ok(v1::ObserveStreamResponse { result: Some(answer) }))
    }

    fn take(&mut self, received: Result<Option<v1::ObserveStreamRequest>, Status>) {
        match received {
            Ok(Some(request)) => self.arrived.push_back(request),
            Ok(None) => self.end = Some(Ok(())),
            Err(status) => self.end = Some(Err(status)),
        }
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
        let latest_wins = self.service.session(&self.session_id)?.terms.latest_wins;
        let skip_image = latest_wins && self.newer_image_arrived();
        let request = v1::ObserveRequest {
            session_id: self.session_id.clone(),
            observation,
            outputs: self.outputs.clone(),
            timeout_millis,
        };
        self.service.observe_unless(skip_image, request, self.call).await
    }

    /// Takes what has arrived by now, and tells whether there is an image in it.
    fn newer_image_arrived(&mut self) -> bool {
        let most = self.service.limits().max_request_bytes as usize;
        let mut bytes: usize = self.arrived.iter().map(v1::ObserveStreamRequest::encoded_len).sum();
        while self.end.is_none() && self.arrived.len() < AHEAD && bytes <= most {
            let Some(received) = self.observations.message().now_or_never() else { break };
            bytes +=
                received.iter().flatten().map(v1::ObserveStreamRequest::encoded_len).sum::<usize>();
            self.take(received);
        }
        let observations = self.arrived.iter().filter_map(|request| request.observation.as_ref());
        observations.into_iter().any(|observation| observation.image.is_some())
    }
}
