//! Where logs and traces go. What is logged can be changed while the server runs.

use std::io::IsTerminal as _;

use tracing_subscriber::{
    EnvFilter, Layer as _, Registry, layer::SubscriberExt as _, reload,
    util::SubscriberInitExt as _,
};

use crate::config::{Config, LogFormat};

/// Logs or traces cannot go where they should.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The filter cannot be understood.
    #[error("the filter of logs cannot be understood")]
    Filter(#[from] tracing_subscriber::filter::ParseError),
    /// The filter cannot be changed.
    #[error("the filter of logs cannot be changed")]
    Gone(#[from] reload::Error),
    /// Traces cannot be sent.
    #[cfg(feature = "otel")]
    #[error("traces cannot be sent")]
    Traces(#[from] opentelemetry_otlp::ExporterBuildError),
}

/// The logs of the process.
#[derive(Debug)]
pub struct Logs {
    filter: reload::Handle<EnvFilter, Registry>,
    #[cfg(feature = "otel")]
    traces: Option<opentelemetry_sdk::trace::SdkTracerProvider>,
}

impl Logs {
    /// Logs to standard error from now on. A panic on the model's thread is caught and reported there, with the
    /// request it hit; here it adds only where it happened.
    ///
    /// # Errors
    /// If the filter cannot be understood, or traces cannot be sent.
    pub fn start(config: &Config) -> Result<Self, LogError> {
        let (layer, filter) = reload::Layer::new(EnvFilter::try_new(&config.log)?);
        let lines = tracing_subscriber::fmt::layer().with_writer(std::io::stderr);
        let lines = match config.log_format {
            LogFormat::Text => lines.with_ansi(std::io::stderr().is_terminal()).boxed(),
            LogFormat::Json => lines.json().flatten_event(true).boxed(),
        };
        let registry = tracing_subscriber::registry().with(layer).with(lines);
        #[cfg(feature = "otel")]
        let logs = {
            let traces = config.otlp_endpoint.as_deref().map(traces).transpose()?;
            let layer = traces.as_ref().map(|traces| {
                use opentelemetry::trace::TracerProvider as _;
                tracing_opentelemetry::layer().with_tracer(traces.tracer("gatsbi-server"))
            });
            registry.with(layer).init();
            Self { filter, traces }
        };
        #[cfg(not(feature = "otel"))]
        let logs = {
            registry.init();
            Self { filter }
        };
        std::panic::set_hook(Box::new(|panic| {
            let on_model = std::thread::current().name() == Some("gatsbi-engine");
            match (panic.location(), on_model) {
                (Some(at), true) => tracing::debug!(%at, "panic on the model's thread"),
                (_, true) => {}
                (_, false) => tracing::error!("{panic}"),
            }
        }));
        Ok(logs)
    }

    /// Logs something else from now on.
    ///
    /// # Errors
    /// If the filter cannot be understood.
    pub fn set(&self, filter: &str) -> Result<(), LogError> {
        Ok(self.filter.reload(EnvFilter::try_new(filter)?)?)
    }

    /// Sends what is still to be sent.
    pub fn end(self) {
        #[cfg(feature = "otel")]
        if let Some(Err(error)) = self.traces.map(|traces| traces.shutdown()) {
            eprintln!("warning: the last traces were not sent: {error}");
        }
    }
}

/// Sends traces to a collector, in batches.
#[cfg(feature = "otel")]
fn traces(endpoint: &str) -> Result<opentelemetry_sdk::trace::SdkTracerProvider, LogError> {
    use opentelemetry_otlp::WithExportConfig as _;
    let exporter =
        opentelemetry_otlp::SpanExporter::builder().with_tonic().with_endpoint(endpoint).build()?;
    let service = opentelemetry_sdk::Resource::builder().with_service_name("gatsbi-server").build();
    let provider = opentelemetry_sdk::trace::SdkTracerProvider::builder();
    Ok(provider.with_batch_exporter(exporter).with_resource(service).build())
}
