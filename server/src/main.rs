//! The server's program: environment, configuration, start, signals, end.

#![expect(clippy::print_stdout, reason = "where it listens is what the program has to say")]

use std::{
    ffi::OsString,
    os::unix::process::CommandExt as _,
    process::{Command, ExitCode},
};

use clap::{Arg, ArgAction, Args as _, CommandFactory as _, FromArgMatches as _, Subcommand as _};
use gatsbi_server::{
    access::command::{KeysTask, Task},
    app::{self, App},
    config::{
        Config,
        layers::{self, Layered, Source, Unusable},
        render::{Style, render},
    },
    logs::Logs,
    reload,
};
use tokio::signal::unix::{SignalKind, signal};

/// Read by libgomp when it loads, which is before `main`. Idle OpenMP threads must sleep: spinning ones slow a
/// shared core down fourfold.
const OPENMP: [(&str, &str); 2] = [("GOMP_SPINCOUNT", "0"), ("OMP_WAIT_POLICY", "PASSIVE")];

/// What cannot be started because it was told wrong.
const MISTAKEN: u8 = 2;

fn main() -> ExitCode {
    let layered = match configuration() {
        Ok(layered) => layered,
        Err(Unusable::Told(told)) => told.exit(),
        Err(Unusable::Problems(problems)) => {
            for problem in problems {
                eprintln!("error: {problem}");
            }
            return ExitCode::from(MISTAKEN);
        }
    };
    let done = match Task::from_arg_matches(&layered.matches) {
        Ok(Task::Keys(KeysTask::New(new))) => {
            new.make().map(|shown| print!("{shown}")).map_err(anyhow::Error::from)
        }
        Err(_no_task) if layered.matches.get_flag("print_config") => {
            print!("{}", render(&layered.matches, Style::Effective));
            Ok(())
        }
        Err(_no_task) => {
            if let Err(error) = with_openmp_settings() {
                eprintln!("warning: libgomp keeps its own settings: {error}");
            }
            run(layered)
        }
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn configuration() -> Result<Layered, Unusable> {
    let arguments: Vec<OsString> = std::env::args_os().collect();
    let print = Arg::new("print_config").long("print-config").action(ArgAction::SetTrue);
    let print =
        print.help("Prints the settings that are in force, as a file for --config, and ends");
    let command = Source::augment_args(Config::command()).arg(print);
    layers::read(Task::augment_subcommands(command).subcommand_required(false), &arguments)
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

fn run(layered: Layered) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Runtime::new()?;
    let done = runtime.block_on(serve(layered));
    // A checkpoint that is being loaded keeps nobody waiting.
    runtime.shutdown_background();
    done
}

async fn serve(layered: Layered) -> anyhow::Result<()> {
    let logs = Logs::start(&layered.config)?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let mut hang_up = signal(SignalKind::hangup())?;
    let starting = App::start(layered.config.clone(), app::load);
    let mut app = tokio::select! {
        app = starting => app?,
        _ = interrupt.recv() => return Ok(()),
        _ = terminate.recv() => return Ok(()),
    };
    println!("ready grpc={} http={} admin={}", app.grpc, app.http, app.admin);
    let lost = loop {
        tokio::select! {
            _ = interrupt.recv() => break false,
            _ = terminate.recv() => break false,
            _ = hang_up.recv() => match configuration() {
                Ok(new) => {
                    tokio::select! {
                        () = reload::apply(&app, &logs, &layered, &new) => {}
                        _ = interrupt.recv() => break false,
                        _ = terminate.recv() => break false,
                    }
                }
                Err(problem) => reload::refused(problem),
            },
            () = app.engine_ended() => break true,
        }
    };
    tracing::info!("shutting down");
    app.shutdown().await;
    logs.end();
    anyhow::ensure!(!lost, "the model's thread has ended");
    Ok(())
}
