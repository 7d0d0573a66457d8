//! `gatsbi`: the service from the command line, for people by default and for machines with `--json`.
//!
//! A command is a file: [`models`], [`sessions`], [`observe`], [`imagine`], [`demo`]. What they share: [`candidates`]
//! and [`recording`] read what is sent, [`mod@print`] and [`picture`] show what came back, [`failure`] says what went
//! wrong. Everything goes through the library, as any other program's calls do.

mod candidates;
mod demo;
mod failure;
mod imagine;
mod models;
mod observe;
mod picture;
mod print;
mod recording;
mod sessions;

use std::{path::PathBuf, process::ExitCode, time::Duration};

use clap::{Args, Parser, Subcommand};
use gatsbi_client::{ApiKey, Client, Options, Session, Tls};

const EXIT_CODES: &str = "\
Exit codes:
  0  done
  1  something failed on this machine, such as writing a file
  2  the command line or a file given with it is wrong
  3  the server refused the request, and said why
  4  the server cannot be reached, or has no room or time now: try again";

/// World models for robot agents: what is in the scene, and what will happen if.
#[derive(Debug, Parser)]
#[command(version, after_help = EXIT_CODES)]
struct Cli {
    #[command(flatten)]
    shared: Shared,
    #[command(subcommand)]
    command: Command,
}

/// What every command understands.
#[derive(Debug, Args)]
struct Shared {
    /// Address of the server's gRPC API
    #[arg(
        long,
        value_name = "URL",
        env = "GATSBI_SERVER",
        default_value = "127.0.0.1:50051",
        global = true
    )]
    server: String,
    /// Key that the server asks for; better in the environment, where others do not see it
    #[arg(long, value_name = "KEY", env = "GATSBI_API_KEY", hide_env_values = true, global = true)]
    api_key: Option<ApiKey>,
    /// Authorities of the server's certificate (PEM); with them TLS is spoken
    #[arg(long, value_name = "PATH", env = "GATSBI_CA", global = true)]
    ca: Option<PathBuf>,
    /// Own certificate (PEM), where the server asks for one
    #[arg(long, value_name = "PATH", global = true)]
    certificate: Option<PathBuf>,
    /// Private key of the own certificate (PEM)
    #[arg(long, value_name = "PATH", global = true)]
    key: Option<PathBuf>,
    /// Print JSON; errors, too, on standard error
    #[arg(long, global = true)]
    json: bool,
    /// Longest wait for an answer
    #[arg(long, value_name = "SECONDS", default_value = "30", value_parser = seconds, global = true)]
    timeout: Duration,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// List the models that the server serves
    Models,
    /// Show a model: sizes, actions, limits, card
    Model {
        /// Its name
        name: String,
    },
    /// Open, show, list and close sessions
    #[command(subcommand)]
    Session(sessions::Command),
    /// Let a session observe recorded frames, or a single image
    Observe(observe::Arguments),
    /// Imagine what will happen under candidate actions
    Imagine(imagine::Arguments),
    /// Observe the start of an episode, imagine the rest, and compare it with what was recorded, in numbers and pictures
    Demo(demo::Arguments),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    let json = cli.shared.json;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let done = runtime.map_err(anyhow::Error::from).and_then(|runtime| runtime.block_on(run(cli)));
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failure::report(&error, json),
    }
}

async fn run(cli: Cli) -> anyhow::Result<()> {
    let shared = &cli.shared;
    match cli.command {
        Command::Models => models::list(shared).await,
        Command::Model { name } => models::show(shared, &name).await,
        Command::Session(command) => sessions::run(shared, command).await,
        Command::Observe(arguments) => observe::run(shared, arguments).await,
        Command::Imagine(arguments) => imagine::run(shared, arguments).await,
        Command::Demo(arguments) => demo::run(shared, arguments).await,
    }
}

impl Shared {
    async fn client(&self) -> anyhow::Result<Client> {
        let read = |path: &PathBuf| fs_err::read(path);
        // clap would not see one that stands before the command and another behind it together.
        let identity = match (&self.certificate, &self.key) {
            (Some(certificate), Some(key)) => Some((read(certificate)?, read(key)?)),
            (None, None) => None,
            _ => anyhow::bail!("--certificate and --key must be given together"),
        };
        let tls = match (&self.ca, identity) {
            (Some(ca), identity) => Some(Tls { ca: read(ca)?, identity, server_name: None }),
            (None, Some(_)) => {
                anyhow::bail!("--certificate needs --ca: without it no TLS is spoken")
            }
            (None, None) => None,
        };
        let api_key = self.api_key.clone();
        let options = Options { timeout: self.timeout, api_key, tls, ..Options::default() };
        Ok(Client::connect_with(&self.server, options).await?)
    }

    async fn session(&self, id: &str) -> anyhow::Result<Session> {
        Ok(self.client().await?.session(id).await?)
    }
}

fn seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse().ok().filter(|seconds| *seconds > 0.0);
    seconds
        .and_then(|seconds| Duration::try_from_secs_f64(seconds).ok())
        .ok_or_else(|| "expected a positive number of seconds".to_owned())
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn times_are_positive() {
        assert_eq!(seconds("0.5"), Ok(Duration::from_millis(500)));
        for wrong in ["0", "-1", "nan", "inf", "soon"] {
            assert!(seconds(wrong).is_err(), "{wrong}");
        }
    }
}
