//! `gatsbi-train`: makes, trains and evaluates checkpoints.

#![expect(clippy::print_stdout, reason = "a command-line program speaks to people")]

use std::path::PathBuf;

use anyhow::{Context as _, bail};
use clap::{Parser, Subcommand};
use gatsbi_models::{
    checkpoint::{Checkpoint, Precision},
    config::presets,
};
use gatsbi_training::untrained;
use tch::Device;

/// Makes, trains and evaluates GATSBI checkpoints.
#[derive(Debug, Parser)]
#[command(version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Write a checkpoint with untrained weights.
    Init {
        /// Sizes: roll, push1, push2, bair, balls or tiny.
        #[arg(long, default_value = "tiny")]
        preset: String,
        /// Seed of the initial weights.
        #[arg(long, default_value_t = 0)]
        seed: u64,
        /// File to write.
        #[arg(long)]
        out: PathBuf,
    },
}

fn main() -> anyhow::Result<()> {
    match Arguments::parse().command {
        Command::Init { preset, seed, out } => {
            let Some(config) = presets::preset(&preset) else {
                bail!("there is no preset {preset}; known are {}", presets::NAMES.join(", "));
            };
            let actions = untrained::plain_actions(config.action.dim);
            let header = untrained::header(&format!("{preset}-untrained"), config, actions, seed);
            Checkpoint::untrained(header, Device::Cpu)
                .save(&out, Precision::Single)
                .context("the checkpoint was not written")?;
            println!("{} (untrained, seed {seed})", out.display());
        }
    }
    Ok(())
}
