//! The project's automation: `cargo xtask <command>`, the same on a laptop and in `.ci/run`.
//!
//! It must build before libtorch is there and is the first thing a newcomer waits for, so it depends on
//! none of our crates and on few others. Read on in [`setup`], which provides libtorch, and [`cargo`],
//! which runs the checks.

mod cargo;
mod libtorch;
mod setup;

use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context as _, Result};
use clap::Parser;

use crate::setup::Variant;

#[derive(Parser)]
#[command(bin_name = "cargo xtask", about = "The project's automation", version = None)]
enum Command {
    /// Provide libtorch 2.11.0 and point .libtorch at it
    ///
    /// It is downloaded once into GATSBI_CACHE (else XDG_CACHE_HOME/gatsbi, else ~/.cache/gatsbi) through pip's
    /// settings; an interrupted set-up continues where it stopped. A libtorch of your own, named by LIBTORCH
    /// or LIBTORCH_USE_PYTORCH, is checked and used instead.
    Setup {
        /// The trimmed folder without CUDA (0.5 GB); the default where there is no NVIDIA driver
        #[arg(long, conflicts_with = "cuda")]
        cpu: bool,
        /// The full set with CUDA 13 (2.5 GB to download, 3.7 GB on disk); the default where there is an NVIDIA driver
        #[arg(long)]
        cuda: bool,
    },
    /// Set up what is missing and run every test of the workspace, doctests included
    Test {
        /// Passed to the test binaries: a name to filter by, --nocapture, --test-threads=1
        #[arg(last = true)]
        args: Vec<String>,
    },
    /// Check formatting, clippy, the documentation and (where cargo-deny is installed) the dependencies
    Lint,
    /// Format the sources
    Fmt,
}

fn main() -> ExitCode {
    match run(Command::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(command: Command) -> Result<()> {
    let root =
        Path::new(env!("CARGO_MANIFEST_DIR")).parent().context("xtask has no parent folder")?;
    match command {
        Command::Setup { cpu: true, .. } => setup::setup(root, Some(Variant::Cpu)),
        Command::Setup { cuda: true, .. } => setup::setup(root, Some(Variant::Cuda)),
        Command::Setup { .. } => setup::setup(root, None),
        Command::Test { args } => cargo::test(root, &args),
        Command::Lint => cargo::lint(root),
        Command::Fmt => cargo::fmt(root),
    }
}
