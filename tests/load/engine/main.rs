//! The engine without a model's cost, and a model without the service's: what the service itself costs.
//!
//! [`null`] is a model that computes next to nothing, served as any other. [`inside`] drives a model, or the use cases,
//! without a connection in between, [`steps`] makes single steps. `cargo xtask bench` puts them beside the service and the
//! model's twin.

#![expect(clippy::print_stdout, reason = "what was measured goes to standard output")]

mod inside;
mod null;
mod steps;

use std::io::{Write as _, stdin, stdout};

use anyhow::Result;
use clap::Parser;
use gatsbi_server::{app::App, config::Config, engine::models::LoadedModel};
use tokio::signal::unix::{SignalKind, signal};

/// Serves a model that computes nothing, or drives a model without a server.
#[derive(Parser)]
#[command(version)]
enum Command {
    /// Serve a model that computes nothing; takes the settings of gatsbi-server
    Null(Box<Config>),
    /// Measure when told to: each line on standard input is answered by a line of numbers
    ///
    /// `imagine CHECKPOINT CANDIDATES HORIZON SECONDS` is answered by steps of rows a second of the model alone, objects
    /// brought to the host; `fork CHECKPOINT SECONDS` by the microseconds of a fork by the use case, and the bytes of an
    /// idle session.
    Inside,
    /// Make steps when told to: each line `CHECKPOINT BATCH STEP SECONDS` on standard input is answered by how often the step
    /// (observe, imagine, train or multiply) was made, its multiply-accumulates, and the bytes of a state
    Steps,
}

fn main() -> Result<()> {
    match Command::parse() {
        Command::Null(config) => tokio::runtime::Runtime::new()?.block_on(serve(*config)),
        Command::Inside => answer(inside::measure),
        Command::Steps => {
            let mut steps = steps::Steps::new();
            answer(|line| steps.measure(line))
        }
    }
}

/// Answers each line of standard input by one.
fn answer(mut measure: impl FnMut(&str) -> Result<String>) -> Result<()> {
    for line in stdin().lines() {
        println!("{}", measure(&line?)?);
        stdout().flush()?;
    }
    Ok(())
}

async fn serve(config: Config) -> Result<()> {
    let mut terminate = signal(SignalKind::terminate())?;
    let model = |_: &Config| {
        let world = Box::new(null::Null::new());
        Ok(vec![LoadedModel { world, name: "null".to_owned(), card: String::new() }])
    };
    let app = App::start(config, model).await?;
    println!("ready grpc={} http={} admin={}", app.grpc, app.http, app.admin);
    terminate.recv().await;
    app.shutdown().await;
    Ok(())
}
