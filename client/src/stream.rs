//! The control loop of one session over one stream.

use gatsbi_proto::v1::{self, observe_stream_response};
use tokio::{
    sync::mpsc,
    time::{Instant, timeout, timeout_at},
};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming};

use crate::{
    belief::Belief,
    client::{Client, Repeat},
    error::{Error, Result},
    request::{Observation, Selection, millis},
};

/// Observations that may be on their way to the connection.
const AHEAD: usize = 4;

/// Observations in, beliefs out, in the same order.
///
/// [`ObserveStream::observe`] is the simple way: one at a time, repeated where that is safe. [`ObserveStream::send`]
/// and [`ObserveStream::next`] let observations travel while the model computes; a stream that breaks has to be picked
/// up by the caller then, from the session's next step on.
#[derive(Debug)]
pub struct ObserveStream {
    client: Client,
    session_id: String,
    outputs: Selection,
    open: Option<Open>,
    unanswered: usize,
}

#[derive(Debug)]
struct Open {
    requests: mpsc::Sender<v1::ObserveStreamRequest>,
    answers: Streaming<v1::ObserveStreamResponse>,
}

impl ObserveStream {
    pub(crate) fn new(client: Client, session_id: String, outputs: Selection) -> Self {
        Self { client, session_id, outputs, open: None, unanswered: 0 }
    }

    /// Sends an observation and waits for its belief. When the stream breaks it is made anew and the observation sent
    /// again; the server knows it by its step.
    ///
    /// # Errors
    /// As [`crate::Session::observe`]; an observation that is refused does not end the stream. [`Error::Input`] while
    /// answers to [`ObserveStream::send`] are outstanding.
    pub async fn observe(&mut self, observation: Observation) -> Result<Belief> {
        if self.unanswered > 0 {
            let expected = "0: their answers are fetched with next";
            return Err(Error::input("unanswered observations", self.unanswered, expected));
        }
        let options = self.client.options().clone();
        let deadline = Instant::now() + options.timeout;
        let mut pauses = options.retries.pauses();
        loop {
            let answer = timeout_at(deadline, self.exchange(observation.clone(), deadline)).await;
            let error = match answer {
                Ok(Ok(belief)) => return Ok(belief),
                Ok(Err(error)) => error,
                Err(_) => {
                    self.close();
                    return Err(Error::TimedOut(options.timeout));
                }
            };
            options
                .retries
                .wait(&error, Repeat::Harmless, &mut pauses, deadline)
                .await
                .ok_or(error)?;
        }
    }

    /// Sends an observation without waiting for its belief. It waits while the server is more than a few observations
    /// behind, so fetch beliefs as you send.
    ///
    /// # Errors
    /// A connection that breaks.
    pub async fn send(&mut self, observation: Observation) -> Result<()> {
        let deadline = Instant::now() + self.client.options().timeout;
        self.send_before(observation, deadline).await
    }

    /// The belief after the oldest observation that is unanswered; nothing if none is.
    ///
    /// # Errors
    /// What the server says about this observation, and the stream goes on; or a connection that breaks or an answer
    /// that does not come in time, and all that was sent stays unanswered.
    pub async fn next(&mut self) -> Option<Result<Belief>> {
        let open = self.open.as_mut().filter(|_| self.unanswered > 0)?;
        let time = self.client.options().timeout;
        let failure = match timeout(time, open.answers.message()).await {
            Ok(Ok(Some(answer))) => {
                self.unanswered -= 1;
                return Some(read(answer));
            }
            Ok(Ok(None)) => broken("the server ended the stream"),
            Ok(Err(status)) => Error::from(status),
            Err(_) => Error::TimedOut(time),
        };
        self.close();
        Some(Err(failure))
    }

    async fn exchange(&mut self, observation: Observation, deadline: Instant) -> Result<Belief> {
        self.send_before(observation, deadline).await?;
        self.next().await.unwrap_or_else(|| Err(broken("the stream is closed")))
    }

    async fn send_before(&mut self, observation: Observation, deadline: Instant) -> Result<()> {
        let request = v1::ObserveStreamRequest {
            session_id: self.session_id.clone(),
            observation: Some(observation.into()),
            outputs: Some(self.outputs.clone().into()),
            timeout_millis: Some(millis(deadline.saturating_duration_since(Instant::now()))),
        };
        let sent = match &self.open {
            Some(open) => {
                open.requests.send(request).await.map_err(|_unsent| broken("the stream ended"))
            }
            None => self.open_with(request).await,
        };
        match sent {
            Ok(()) => self.unanswered += 1,
            Err(_) => self.close(),
        }
        sent
    }

    /// Opens the stream with its first message, which a server may wait for before it answers at all.
    async fn open_with(&mut self, first: v1::ObserveStreamRequest) -> Result<()> {
        let (requests, queue) = mpsc::channel(AHEAD);
        requests.send(first).await.map_err(|_unsent| broken("the stream is closed"))?;
        let mut service = self.client.session_service();
        let answers = service.observe_stream(ReceiverStream::new(queue)).await?.into_inner();
        self.open = Some(Open { requests, answers });
        Ok(())
    }

    fn close(&mut self) {
        self.open = None;
        self.unanswered = 0;
    }
}

fn read(answer: v1::ObserveStreamResponse) -> Result<Belief> {
    match answer.result {
        Some(observe_stream_response::Result::Belief(belief)) => belief.try_into(),
        Some(observe_stream_response::Result::Problem(problem)) => Err(problem.into()),
        None => Err(Error::Answer("neither belief nor problem".into())),
    }
}

fn broken(what: &str) -> Error {
    Error::Broken(Box::new(Status::unavailable(what)))
}
