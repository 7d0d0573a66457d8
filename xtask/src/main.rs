//! The project's automation: `cargo xtask <command>`, the same on a laptop and in `.ci/run`.
//!
//! It must build before libtorch is there and is the first thing a newcomer waits for, so it depends on
//! none of our crates and on few others. Read on in [`setup`], which provides libtorch, [`cargo`], which runs
//! the checks and builds, and [`demo`], which shows the whole; [`twin`] and [`mod@bench`] hold the model against a second
//! one in PyTorch, [`mod@bundle_train`] takes training elsewhere, [`package`] makes what is shipped. [`process`] looks
//! after programs that run beside it.

mod bench;
mod bundle_train;
mod cargo;
mod demo;
mod libtorch;
mod metrics;
mod mujoco;
mod package;
mod process;
mod server;
mod setup;
mod twin;

use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context as _, Result};
use clap::Parser;

use crate::setup::Variant;

#[derive(Parser)]
#[command(bin_name = "cargo xtask", about = "The project's automation", version = None)]
enum Command {
    /// Provide libtorch 2.11.0 and MuJoCo 3.17.0, and point .libtorch and .mujoco at them
    ///
    /// They are downloaded once into GATSBI_CACHE (else XDG_CACHE_HOME/gatsbi, else ~/.cache/gatsbi) through pip's
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
    /// Serve recorded robot episodes from the bundled model, and show what it sees and imagines
    ///
    /// Sets up and builds what is missing, starts the server on free ports of the loopback, runs `gatsbi demo` against
    /// it, and stops it again. Numbers are printed, pictures left in demo-out.
    Demo(demo::Arguments),
    /// Set up what is missing and run every test of the workspace, doctests included
    Test {
        /// Passed to the test binaries: a name to filter by, --nocapture, --test-threads=1
        #[arg(last = true)]
        args: Vec<String>,
    },
    /// Check formatting, clippy, the documentation and (where cargo-deny is installed) the dependencies
    Lint,
    /// Compare the Rust model with its twin in PyTorch at full size; prints the table of differences
    ///
    /// Makes .venv-twin with torch 2.11.0 from where pip is set to find it, unless it is there. Untrained checkpoints are
    /// recorded with the twin on the spot, in about four minutes on two cores.
    Twin {
        /// Sizes to compare: tiny, push1, bair, balls; all by default
        #[arg(value_name = "PRESET")]
        presets: Vec<String>,
    },
    /// Measure steps of the Rust model beside its twin in PyTorch, on one thread each
    ///
    /// Both have the same weights and take turns, so that what else the machine does hits both; rely on the ratios.
    Bench(bench::Arguments),
    /// Make a folder that trains on another machine, which needs PyTorch 2.11 for Python and nothing else
    BundleTrain(bundle_train::Arguments),
    /// Provide the pretrained networks of the perceptual metrics (110 MB to download); prints the file for gatsbi-train eval
    Metrics,
    /// Make a tarball that runs wherever it is unpacked: programs, libraries, the bundled checkpoint, settings, licences
    ///
    /// It is left in target/package.
    Package(package::Arguments),
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
        Command::Demo(arguments) => demo::demo(root, &arguments),
        Command::Test { args } => cargo::test(root, &args),
        Command::Lint => cargo::lint(root),
        Command::Twin { presets } => twin::agree(root, &presets),
        Command::Bench(arguments) => bench::bench(root, &arguments),
        Command::BundleTrain(arguments) => bundle_train::bundle(root, &arguments),
        Command::Package(arguments) => package::package(root, &arguments),
        Command::Metrics => metrics::provide(),
        Command::Fmt => cargo::fmt(root),
    }
}
