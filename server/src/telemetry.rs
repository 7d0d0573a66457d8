//! Metrics: every name in one table, what may be a label, and how they are switched on.
//!
//! Labels are models, methods and reasons, of which there are few; never sessions. The administration listener
//! shows them (`/metrics`). Logs are `tracing` events and spans; the program decides where they go.

use std::{
    sync::OnceLock,
    time::{Duration, Instant, SystemTime},
};

use metrics::{Counter, Histogram, counter, gauge, histogram};
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};

use crate::{api::problem, engine::commands::Failure, error::Error};

/// A metric.
struct Metric {
    name: &'static str,
    what: &'static str,
    kind: MetricKind,
}

enum MetricKind {
    Counter,
    Gauge,
    Histogram,
}

const REQUESTS: &str = "gatsbi_requests_total";
const REQUEST_SECONDS: &str = "gatsbi_request_duration_seconds";
const REFUSALS: &str = "gatsbi_refusals_total";
const BATCH_ROWS: &str = "gatsbi_batch_rows";
const BATCH_FILL: &str = "gatsbi_batch_fill_ratio";
const STEP_SECONDS: &str = "gatsbi_step_duration_seconds";
const FAILURES: &str = "gatsbi_model_failures_total";
const TURNED_AWAY: &str = "gatsbi_turned_away_total";
const GIVEN_UP: &str = "gatsbi_given_up_total";
const IMAGES_SKIPPED: &str = "gatsbi_images_skipped_total";
const CERTIFICATE_ENDS: &str = "gatsbi_certificate_expiry_timestamp_seconds";
const SESSIONS: &str = "gatsbi_sessions";
const SESSION_BYTES: &str = "gatsbi_session_bytes";
const QUEUE_SECONDS: &str = "gatsbi_queue_duration_seconds";

/// All metrics.
const METRICS: &[Metric] = &[
    Metric {
        name: REQUESTS,
        what: "Requests by api, method and result",
        kind: MetricKind::Counter,
    },
    Metric {
        name: REQUEST_SECONDS,
        what: "Time to answer by api and method; to the end of a stream",
        kind: MetricKind::Histogram,
    },
    Metric { name: REFUSALS, what: "Requests not let in, by reason", kind: MetricKind::Counter },
    Metric {
        name: QUEUE_SECONDS,
        what: "Waiting for the model, by kind of step",
        kind: MetricKind::Histogram,
    },
    Metric {
        name: BATCH_ROWS,
        what: "Rows computed together, padding not counted, by model and kind",
        kind: MetricKind::Histogram,
    },
    Metric {
        name: BATCH_FILL,
        what: "Share of a block that was not padding, by model and kind",
        kind: MetricKind::Histogram,
    },
    Metric {
        name: STEP_SECONDS,
        what: "Time of one block through the model, by model and kind",
        kind: MetricKind::Histogram,
    },
    Metric {
        name: FAILURES,
        what: "Requests that the model failed, by model and failure",
        kind: MetricKind::Counter,
    },
    Metric {
        name: GIVEN_UP,
        what: "Requests whose client went away before they were computed, by model",
        kind: MetricKind::Counter,
    },
    Metric {
        name: IMAGES_SKIPPED,
        what: "Images passed over for newer ones",
        kind: MetricKind::Counter,
    },
    Metric {
        name: TURNED_AWAY,
        what: "Requests without a key that is good for them, by reason",
        kind: MetricKind::Counter,
    },
    Metric {
        name: CERTIFICATE_ENDS,
        what: "When the certificate of the server ends, in seconds since 1970; with TLS only",
        kind: MetricKind::Gauge,
    },
    Metric { name: SESSIONS, what: "Open sessions", kind: MetricKind::Gauge },
    Metric { name: SESSION_BYTES, what: "Memory of open sessions", kind: MetricKind::Gauge },
];

/// Kind of a step.
#[derive(Clone, Copy, Debug)]
pub enum Kind {
    /// With an observation.
    Observe,
    /// Of a rollout.
    Imagine,
}

impl Kind {
    fn label(self) -> &'static str {
        match self {
            Self::Observe => "observe",
            Self::Imagine => "imagine",
        }
    }
}

/// What the model's thread counts for one model.
#[derive(Debug)]
pub struct StepMetrics {
    panicked: Counter,
    not_finite: Counter,
    given_up: Counter,
    kinds: [[Histogram; 3]; 2],
}

impl StepMetrics {
    /// The metrics of `model`.
    pub fn new(model: &str) -> Self {
        let of = |kind: Kind| {
            [BATCH_ROWS, BATCH_FILL, STEP_SECONDS]
                .map(|name| histogram!(name, "model" => model.to_owned(), "kind" => kind.label()))
        };
        // Shown as 0 from the start: an increase from nothing is none, and the first failure would raise no alarm.
        let failed =
            |failure| counter!(FAILURES, "model" => model.to_owned(), "failure" => failure);
        Self {
            panicked: failed("panicked"),
            not_finite: failed("not_finite"),
            given_up: counter!(GIVEN_UP, "model" => model.to_owned()),
            kinds: [of(Kind::Observe), of(Kind::Imagine)],
        }
    }

    /// A block went through the model.
    pub fn batch(&self, kind: Kind, rows: usize, lanes: usize, elapsed: Duration) {
        let [batch_rows, fill, seconds] = &self.kinds[kind as usize];
        batch_rows.record(rows as f64);
        fill.record(rows as f64 / lanes as f64);
        seconds.record(elapsed);
    }

    /// The model failed a request; being late is not its fault.
    pub fn failed(&self, failure: Failure) {
        match failure {
            Failure::Late => {}
            Failure::Panicked => self.panicked.increment(1),
            Failure::NotFinite => self.not_finite.increment(1),
        }
    }

    /// A client went away.
    pub fn given_up(&self) {
        self.given_up.increment(1);
    }
}

/// A request waited for the model.
pub fn waited(kind: Kind, queue: Duration) {
    histogram!(QUEUE_SECONDS, "kind" => kind.label()).record(queue);
}

/// An image was passed over for a newer one.
pub fn image_skipped() {
    counter!(IMAGES_SKIPPED).increment(1);
}

/// A request came without a key that is good for it.
pub fn turned_away(reason: &'static str) {
    counter!(TURNED_AWAY, "reason" => reason).increment(1);
}

/// When the certificate ends.
pub fn certificate_ends(at: SystemTime) {
    let since = at.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    gauge!(CERTIFICATE_ENDS).set(since.as_secs() as f64);
}

/// Sessions were opened or closed.
pub fn sessions(count: usize, bytes: usize) {
    gauge!(SESSIONS).set(count as f64);
    gauge!(SESSION_BYTES).set(bytes as f64);
}

/// A request that is being answered; what it counts as is said once.
#[derive(Debug)]
pub struct Request {
    api: &'static str,
    method: &'static str,
    since: Instant,
    open: bool,
}

impl Request {
    /// A request to `method` that came over `api`.
    pub fn new(api: &'static str, method: &'static str) -> Self {
        Self { api, method, since: Instant::now(), open: true }
    }

    /// The use case has ended.
    pub fn done<T>(self, result: Result<T, Error>) -> Result<T, Error> {
        match &result {
            Ok(_) => self.answered(),
            Err(error) => self.failed(error),
        }
        result
    }

    /// The answer is there.
    pub fn answered(mut self) {
        self.count("OK");
    }

    /// There is an error instead of an answer.
    pub fn failed(mut self, error: &Error) {
        let reason = problem::entry(error).reason;
        if let Error::Overloaded { .. }
        | Error::TooSlow { .. }
        | Error::TooManySessions { .. }
        | Error::QuotaExceeded { .. }
        | Error::TooMuchKept { .. } = error
        {
            counter!(REFUSALS, "reason" => reason).increment(1);
        }
        tracing::debug!(method = self.method, reason, %error, "refused");
        self.count(reason);
    }

    fn count(&mut self, result: &'static str) {
        self.open = false;
        let (api, method, elapsed) = (self.api, self.method, self.since.elapsed());
        counter!(REQUESTS, "api" => api, "method" => method, "result" => result).increment(1);
        histogram!(REQUEST_SECONDS, "api" => api, "method" => method).record(elapsed);
        tracing::debug!(api, method, result, micros = elapsed.as_micros(), "answered");
    }
}

impl Drop for Request {
    /// Whoever goes away before the answer is there is counted too.
    fn drop(&mut self) {
        if self.open {
            self.count("CANCELLED");
        }
    }
}

/// Name, kind and meaning of every metric.
pub fn described() -> impl ExactSizeIterator<Item = (&'static str, &'static str, &'static str)> {
    METRICS.iter().map(|Metric { name, what, kind }| {
        let kind = match kind {
            MetricKind::Counter => "counter",
            MetricKind::Gauge => "gauge",
            MetricKind::Histogram => "histogram",
        };
        (*name, kind, *what)
    })
}

/// Switches metrics on for the process, once, and gives what renders them.
pub fn metrics() -> &'static PrometheusHandle {
    static HANDLE: OnceLock<PrometheusHandle> = OnceLock::new();
    HANDLE.get_or_init(|| {
        let exponential = |first: f64, factor: f64, count: i32| -> Vec<f64> {
            (0..count).map(|i| first * factor.powi(i)).collect()
        };
        let builder = PrometheusBuilder::new()
            .set_buckets_for_metric(Matcher::Suffix("_seconds".into()), &exponential(1e-4, 2.0, 18))
            .and_then(|builder| {
                let rows = exponential(1.0, 2.0, 9);
                builder.set_buckets_for_metric(Matcher::Full(BATCH_ROWS.into()), &rows)
            })
            .and_then(|builder| {
                let eighths: Vec<f64> = (1..=8).map(|i| f64::from(i) / 8.0).collect();
                builder.set_buckets_for_metric(Matcher::Full(BATCH_FILL.into()), &eighths)
            });
        let recorder = builder.expect("the buckets are not empty").build_recorder();
        let handle = recorder.handle();
        // An embedding program may record elsewhere; then there is nothing to show here.
        metrics::set_global_recorder(recorder).ok();
        for Metric { name, what, kind } in METRICS {
            match kind {
                MetricKind::Counter => metrics::describe_counter!(*name, *what),
                MetricKind::Gauge => metrics::describe_gauge!(*name, *what),
                MetricKind::Histogram => metrics::describe_histogram!(*name, *what),
            }
        }
        handle
    })
}
