//! What both skins do around a use case: a span, and counting what became of it.

use futures_util::{Stream, StreamExt as _, stream::unfold};
use gatsbi_proto::v1;
use tracing::Instrument as _;

use crate::{error::Error, service::rollout::Rollout, telemetry::Request};

/// Runs a use case that came over `api`.
pub(super) async fn answer<T>(
    api: &'static str,
    method: &'static str,
    answer: impl Future<Output = Result<T, Error>>,
) -> Result<T, Error> {
    let request = Request::new(api, method);
    let span = tracing::info_span!("request", api, method);
    request.done(answer.instrument(span).await)
}

/// A rollout that is counted when it has ended.
#[derive(Debug)]
pub(super) struct CountedRollout {
    rollout: Rollout,
    request: Option<Request>,
}

/// Starts a rollout that came over `api`.
pub(super) async fn rollout(
    api: &'static str,
    start: impl Future<Output = Result<Rollout, Error>>,
) -> Result<CountedRollout, Error> {
    let request = Request::new(api, "Imagine");
    let span = tracing::info_span!("request", api, method = "Imagine");
    match start.instrument(span).await {
        Ok(rollout) => Ok(CountedRollout { rollout, request: Some(request) }),
        Err(error) => {
            request.failed(&error);
            Err(error)
        }
    }
}

/// A stream that came over `api`, counted when it has ended.
pub(super) fn stream<S: Stream>(
    api: &'static str,
    method: &'static str,
    answers: S,
) -> impl Stream<Item = S::Item> {
    let state = (Box::pin(answers), Request::new(api, method));
    unfold(state, |(mut answers, request)| async move {
        let Some(answer) = answers.next().await else {
            request.answered();
            return None;
        };
        Some((answer, (answers, request)))
    })
}

impl CountedRollout {
    /// The next chunk; nothing after the last one or an error.
    pub(super) async fn next(&mut self) -> Option<Result<v1::ImagineResponse, Error>> {
        let chunk = self.rollout.next().await;
        match (&chunk, self.request.take_if(|_| !matches!(chunk, Some(Ok(_))))) {
            (Some(Err(error)), Some(request)) => request.failed(error),
            (_, Some(request)) => request.answered(),
            (_, None) => {}
        }
        Some(chunk?.map(|chunk| v1::ImagineResponse { chunk: Some(chunk) }))
    }
}
