//! A session: one robot's stream of observations, and the belief that the server keeps of its scene.

use std::sync::atomic::{AtomicUsize, Ordering};

use gatsbi_proto::v1;
use tonic::{Code, Request, Response};

use crate::{
    SessionInfo,
    belief::Belief,
    client::{Client, Repeat},
    error::{Error, Result},
    request::{Imagination, Observation, Selection, millis},
    rollout::RolloutStream,
    stream::ObserveStream,
};

/// An open session. It is the server's: handles may be cloned and dropped, and others may hold one too.
#[derive(Clone, Debug)]
pub struct Session {
    client: Client,
    info: SessionInfo,
}

impl Session {
    pub(crate) fn new(client: Client, info: SessionInfo) -> Self {
        Self { client, info }
    }

    /// Its id. Whoever knows it may use the session.
    pub fn id(&self) -> &str {
        &self.info.id
    }

    /// What the server told when this handle was made; [`Session::refresh`] asks again.
    pub fn info(&self) -> &SessionInfo {
        &self.info
    }

    /// Asks how the session stands, for instance for the next step after a failure.
    ///
    /// # Errors
    /// `UNKNOWN_SESSION`.
    pub async fn refresh(&mut self) -> Result<&SessionInfo> {
        self.info = self.client.session_info(self.id()).await?;
        Ok(&self.info)
    }

    /// Absorbs one observation. A call whose answer was lost is repeated, and the server then gives the stored answer:
    /// the belief advances once.
    ///
    /// # Errors
    /// `STEP_GAP`, `STEP_CONFLICT`, `INVALID_FIELDS`, `OUTPUT_UNAVAILABLE`, `OVERLOADED`: the belief has not moved.
    /// After [`Error::TimedOut`] and [`Error::Broken`] it may have; the same call again tells.
    pub async fn observe(&self, observation: Observation, outputs: &Selection) -> Result<Belief> {
        let request = v1::ObserveRequest {
            session_id: self.info.id.clone(),
            observation: Some(observation.into()),
            outputs: Some(outputs.clone().into()),
            timeout_millis: Some(millis(self.client.options().timeout)),
        };
        let answer = self
            .client
            .call(Repeat::Harmless, request, |request| {
                let mut service = self.client.session_service();
                async move { service.observe(request).await }
            })
            .await?;
        answer.belief.ok_or_else(|| Error::Answer("a belief is missing".into()))?.try_into()
    }

    /// The control loop: observations over one stream, which opens with the first and is made anew when it breaks.
    pub fn observe_stream(&self, outputs: &Selection) -> ObserveStream {
        ObserveStream::new(self.client.clone(), self.info.id.clone(), outputs.clone())
    }

    /// Imagines futures; returns when the first chunk is there. The session is untouched.
    ///
    /// Until then the call is repeated as any other. A rollout that breaks later has to be asked for again; with the
    /// same seed its chunks are the same.
    ///
    /// # Errors
    /// `NOTHING_OBSERVED`, `SESSION_MOVED`, `INVALID_FIELDS`, `OUTPUT_UNAVAILABLE`, `OVERLOADED`, `DEADLINE_EXCEEDED`.
    pub async fn imagine(&self, imagination: Imagination) -> Result<RolloutStream> {
        let samples = imagination.sampling.samples() as usize;
        let candidates = imagination.actions.candidates();
        let depths = imagination.outputs.depths(imagination.actions.horizon());
        let patience = self.client.options().timeout.max(imagination.timeout.unwrap_or_default());
        let request = imagination.into_request(self.info.id.clone());
        let (first, chunks) = self
            .client
            .call_within(patience, Repeat::Harmless, request, |request| {
                let mut service = self.client.imagination_service();
                async move {
                    // Without the time limit of the call, which the server would apply to the whole rollout.
                    let mut chunks =
                        service.imagine(Request::new(request.into_inner())).await?.into_inner();
                    let first = chunks.message().await?;
                    Ok(Response::new((first, chunks)))
                }
            })
            .await?;
        Ok(RolloutStream::new(chunks, first, patience, [candidates, samples], depths))
    }

    /// Closes the session; its belief is forgotten.
    ///
    /// # Errors
    /// `UNKNOWN_SESSION`.
    pub async fn delete(self) -> Result<()> {
        let request = v1::DeleteSessionRequest { session_id: self.info.id.clone() };
        let asked = AtomicUsize::new(0);
        let answer = self
            .client
            .call(Repeat::Harmless, request, |request| {
                let mut service = self.client.session_service();
                asked.fetch_add(1, Ordering::Relaxed);
                async move { service.delete_session(request).await }
            })
            .await;
        let repeated = asked.into_inner() > 1;
        match answer {
            // The session went with the call whose answer was lost.
            Err(Error::Refused(problem)) if repeated && problem.code == Code::NotFound => Ok(()),
            Err(error) => Err(error),
            Ok(v1::DeleteSessionResponse {}) => Ok(()),
        }
    }
}
