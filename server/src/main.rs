//! The server's program: environment, configuration, start, signals, end.

#![expect(clippy::print_stdout, reason = "where it listens is what the program has to say")]

use std::{
    io::IsTerminal as _,
    os::unix::process::CommandExt as _,
    process::{Command, ExitCode},
};

use anyhow::Context as _;
use clap::Parser as _;
use gatsbi_server::{
    app::{self, App},
    config::Config,
};
use tokio::signal::unix::{SignalKind, signal};

/// Read by libgomp when it loads, which is before `main`. Idle OpenMP threads must sleep: spinning ones slow a
/// shared core down fourfold.
const OPENMP: [(&str, &str); 2] = [("GOMP_SPINCOUNT", "0"), ("OMP_WAIT_POLICY", "PASSIVE")];

fn main() -> ExitCode {
    if let Err(error) = with_openmp_settings() {
        eprintln!("warning: libgomp keeps its own settings: {error}");
    }
    let config = Config::parse();
    let problems = config.problems();
    if !problems.is_empty() {
        for problem in problems {
            eprintln!("error: {problem}");
        }
        return ExitCode::from(2);
    }
    match run(config) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Starts the program anew, once, if OpenMP's settings are not there.
fn with_openmp_settings() -> std::io::Result<()> {
    let missing = OPENMP.into_iter().filter(|(name, _)| std::env::var_os(name).is_none());
    let missing: Vec<_> = missing.collect();
    if missing.is_empty() {
        return Ok(());
    }
    let mut arguments = std::env::args_os();
    let mut again = Command::new(std::env::current_exe()?);
    if let Some(name) = arguments.next() {
        again.arg0(name);
    }
    Err(again.args(arguments).envs(missing).exec())
}

#[tokio::main]
async fn run(config: Config) -> anyhow::Result<()> {
    logs(&config.log).context("--log cannot be understood")?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let starting = App::start(config, app::load);
    let mut app = tokio::select! {
        app = starting => app?,
        _ = interrupt.recv() => return Ok(()),
        _ = terminate.recv() => return Ok(()),
    };
    println!("ready grpc={} http={} admin={}", app.grpc, app.http, app.admin);
    let lost = tokio::select! {
        _ = interrupt.recv() => false,
        _ = terminate.recv() => false,
        () = app.engine_ended() => true,
    };
    tracing::info!("shutting down");
    app.shutdown().await;
    anyhow::ensure!(!lost, "the model's thread has ended");
    Ok(())
}

/// Logs to standard error. A panic on the model's thread is caught and reported there, with the request it hit;
/// here it adds only where it happened.
fn logs(filter: &str) -> anyhow::Result<()> {
    let filter = tracing_subscriber::EnvFilter::try_new(filter)?;
    let colours = std::io::stderr().is_terminal();
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_ansi(colours);
    log.with_writer(std::io::stderr).init();
    std::panic::set_hook(Box::new(|panic| {
        let on_model = std::thread::current().name() == Some("gatsbi-engine");
        match (panic.location(), on_model) {
            (Some(at), true) => tracing::debug!(%at, "panic on the model's thread"),
            (_, true) => {}
            (_, false) => tracing::error!("{panic}"),
        }
    }));
    Ok(())
}
