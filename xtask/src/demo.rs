//! The demonstration: the real server and the real command line, on recorded robot episodes.
//!
//! What is shown and measured is `gatsbi demo`'s business (in `client`); here everything it needs is provided, and
//! cleared away afterwards.

use std::env;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use fs_err as fs;

use crate::cargo;
use crate::process::{Interrupt, Running};
use crate::server::Server;
use crate::setup;

/// What is shown, and the checkpoint that knows such scenes.
const SAMPLES: &str = "episodes/samples/push1-heldout.parquet";
const BUNDLED: &str = "models/checkpoints/push1-tiny.safetensors";

/// For the demonstration to end in.
const GRACE: Duration = Duration::from_secs(30);

#[derive(Args)]
pub(crate) struct Arguments {
    /// Leave the server running, and say where it is and how to stop it
    #[arg(long)]
    keep: bool,
    /// Checkpoint to serve; by default the bundled one
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,
    /// Episode file; by default the sample episodes
    #[arg(long, value_name = "FILE")]
    episodes: Option<PathBuf>,
    /// Episode in the file, from 0
    #[arg(long, value_name = "N", default_value_t = 0)]
    index: usize,
    /// Folder for pictures and the server's log; by default demo-out
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

/// Shows the whole service on one episode.
pub(crate) fn demo(root: &Path, arguments: &Arguments) -> Result<()> {
    let given = [&arguments.checkpoint, &arguments.episodes];
    for file in given.into_iter().flatten() {
        ensure!(file.is_file(), "{} is no file", file.display());
    }
    setup::ensure_set_up(root)?;
    let programs = cargo::build(
        root,
        "build --workspace --locked --bin gatsbi-server --bin gatsbi --bin gatsbi-train",
    )?;
    let interrupt = Interrupt::watch()?;
    let out = arguments.out.clone().unwrap_or_else(|| short(&root.join("demo-out")));
    fs::create_dir_all(&out)?;

    let bundled = root.join(BUNDLED);
    let checkpoint = match &arguments.checkpoint {
        Some(file) => file.clone(),
        None if bundled.is_file() => bundled,
        None => untrained(programs.named("gatsbi-train")?, &out)?,
    };
    let log = out.join("server.log");
    let mut command = Command::new(programs.named("gatsbi-server")?);
    command.arg("--checkpoint").arg(&checkpoint);
    let server = Server::start(&mut command, &log, &interrupt)?;
    let episodes = arguments.episodes.clone().unwrap_or_else(|| short(&root.join(SAMPLES)));
    let mut client = Command::new(programs.named("gatsbi")?);
    client.args(["demo", "--server", &server.grpc, "--index", &arguments.index.to_string()]);
    client.arg("--episodes").arg(&episodes).arg("--out").arg(&out);
    let shown = Running::start(&mut client, GRACE)?.wait(&interrupt);
    if arguments.keep && shown.is_ok() {
        keep(server, &short(programs.named("gatsbi")?), &log);
        return Ok(());
    }
    let stopped = server.process.stop();
    shown?;
    stopped.with_context(|| format!("its log is {}", log.display()))
}

/// A model that has learned nothing, and shows as much.
fn untrained(trainer: &Path, out: &Path) -> Result<PathBuf> {
    let checkpoint = out.join("tiny-untrained.safetensors");
    let mut command = Command::new(trainer);
    command.args(["init", "--preset", "tiny", "--out"]).arg(&checkpoint).stdout(Stdio::null());
    let status = command.status().context("gatsbi-train cannot be run")?;
    ensure!(status.success(), "gatsbi-train made no checkpoint ({status})");
    eprintln!("no checkpoint is bundled: the model is untrained, so expect noise, not a scene");
    Ok(checkpoint)
}

/// Leaves a server running, and says where it is.
fn keep(server: Server, client: &Path, log: &Path) {
    let Server { process, grpc, http, admin } = server;
    let id = process.leave();
    eprintln!(
        "\nthe server goes on (its log is {})\n  gRPC   {grpc}\n         {} models --server {grpc}\n  \
         REST   {http}\n         curl {http}/v1/models\n  admin  {admin}/metrics\n  stop   kill {id}",
        log.display(),
        client.display(),
    );
}

/// A path as one would type it here.
fn short(path: &Path) -> PathBuf {
    let here = env::current_dir().ok();
    let short = here.as_deref().and_then(|here| path.strip_prefix(here).ok());
    short.unwrap_or(path).to_owned()
}
