//! What both skins do around a use case: a span, and counting what became of it.

use futures_util::{Stream, StreamExt as _, stream::unfold};
use gatsbi_proto::v1;
use tracing::{Instrument as _, Span, info_span};

use crate::{error::Error, service::rollout::Rollout, telemetry::Request};

/// Runs a use case that came over `api`.
pub(super) async fn answer<T>(
    api: &'static str,
    method: &'static str,
    answer: impl Future<Output = Result<T, Error>>,
) -> Result<T, Error> {
    let request = Request::new(api, method);
    let span = info_span!("request", api, method);
    request.done(answer.instrument(span).await)
}

/// A rollout that is counted when it has ended.
#[derive(Debug)]
pub(super) struct CountedRollout {
    rollout: Rollout,
    request: Option<Request>,
    span: Span,
}

/// Starts a rollout that came over `api`.
pub(super) async fn rollout(
    api: &'static str,
    start: impl Future<Output = Result<Rollout, Error>>,
) -> Result<CountedRollout, Error> {
    let request = Request::new(api, "Imagine");
    let span = info_span!("request", api, method = "Imagine");
    match start.instrument(span.clone()).await {
        Ok(rollout) => Ok(CountedRollout { rollout, request: Some(request), span }),
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
    let span = info_span!("request", api, method);
    let state = (Box::pin(answers), Request::new(api, method), span);
    unfold(state, |(mut answers, request, span)| async move {
        let Some(answer) = answers.next().instrument(span.clone()).await else {
            request.answered();
            return None;
        };
        Some((answer, (answers, request, span)))
    })
}

impl CountedRollout {
    /// The next chunk; nothing after the last one or an error.
    pub(super) async fn next(&mut self) -> Option<Result<v1::ImagineResponse, Error>> {
        let chunk = self.rollout.next().instrument(self.span.clone()).await;
        match (&chunk, self.request.take_if(|_| !matches!(chunk, Some(Ok(_))))) {
            (Some(Err(error)), Some(request)) => request.failed(error),
            (_, Some(request)) => request.answered(),
            (_, None) => {}
        }
        Some(chunk?.map(|chunk| v1::ImagineResponse { chunk: Some(chunk) }))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use futures_util::stream::iter;
    use tracing::{Event, Level, span::Id};
    use tracing_subscriber::{
        Layer, Registry,
        layer::{Context, SubscriberExt as _},
    };

    use super::*;

    /// In which span things happened, and when it ended.
    #[derive(Clone, Default)]
    struct Told(Arc<Mutex<Vec<String>>>);

    impl Layer<Registry> for Told {
        fn on_event(&self, event: &Event<'_>, context: Context<'_, Registry>) {
            if *event.metadata().level() == Level::INFO {
                let span = context.event_span(event).map(|span| span.name());
                self.0.lock().unwrap().push(format!("in {span:?}"));
            }
        }

        fn on_close(&self, _: Id, _: Context<'_, Registry>) {
            self.0.lock().unwrap().push("end".to_owned());
        }
    }

    #[tokio::test]
    async fn a_stream_is_one_span_to_its_end() {
        let told = Told::default();
        let _scope = tracing::subscriber::set_default(Registry::default().with(told.clone()));
        let answers = iter([1, 2]).inspect(|_| tracing::info!("an answer"));
        let answers = stream("rest", "PredictBatch", answers);
        assert_eq!(answers.collect::<Vec<_>>().await, [1, 2]);
        let inside = "in Some(\"request\")";
        assert_eq!(*told.0.lock().unwrap(), [inside, inside, "end"]);
    }
}
