//! One folder that trains elsewhere: trainer, episodes, recipe and a script, for a machine (with a GPU, say) that has
//! PyTorch 2.11 for Python and nothing else of what building takes.

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use fs_err as fs;

use crate::cargo;
use crate::setup;

/// What a bundle may weigh, in bytes: it must be quick to move.
const HEAVIEST: u64 = 60_000_000;

const RUN: &str = r#"#!/bin/sh
# Trains here, with the libraries of Python's torch 2.11, and goes on where it stopped. DEVICE is cpu or cuda:N, by
# default the GPU if there is one; OUT is the run's folder; arguments go to gatsbi-train (--seed 1, --range 0 240).
set -eu
here=$(cd "$(dirname "$0")" && pwd)
torch=$(python3 -c '
import sys, torch
if not torch.__version__.startswith("2.11."):
    sys.exit(f"torch is {torch.__version__}, expected 2.11")
print(torch.__path__[0])')
device=${DEVICE:-$(python3 -c 'import torch; print("cuda:0" if torch.cuda.is_available() else "cpu")')}
export LD_LIBRARY_PATH="$torch/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}" GOMP_SPINCOUNT=0 OMP_WAIT_POLICY=PASSIVE
exec "$here/gatsbi-train" train --recipe "$here/recipe.toml" --episodes "$here/episodes" \
  --out "${OUT:-$here/run}" --device "$device" "$@"
"#;

#[derive(Args)]
pub(crate) struct Arguments {
    /// Recipe: a file, or the name of one in training/recipes
    #[arg(long, default_value = "push1")]
    recipe: PathBuf,
    /// Data set: a folder or file of episodes
    #[arg(long)]
    episodes: PathBuf,
    /// Folder to make; there must be none of this name
    #[arg(long, default_value = "bundle-train")]
    out: PathBuf,
}

/// Makes the folder.
pub(crate) fn bundle(root: &Path, arguments: &Arguments) -> Result<()> {
    let Arguments { recipe, episodes, out } = arguments;
    let named = root.join("training/recipes").join(recipe).with_extension("toml");
    let recipe = if recipe.is_file() { recipe } else { &named };
    ensure!(recipe.is_file(), "there is no recipe {}", recipe.display());
    ensure!(episodes.exists(), "there are no episodes {}", episodes.display());
    ensure!(!out.exists(), "{} is there already", out.display());
    setup::ensure_set_up(root)?;
    let programs = cargo::build(root, "build --release --locked --bin gatsbi-train")?;
    fs::create_dir_all(out)?;
    let trainer = out.join("gatsbi-train");
    let stripped = Command::new("strip")
        .args(["--strip-debug", "-o"])
        .args([&trainer, programs.named("gatsbi-train")?])
        .status()
        .context("strip (of binutils) is missing")?;
    ensure!(stripped.success(), "strip failed");
    fs::copy(recipe, out.join("recipe.toml"))?;
    copy(episodes, &out.join("episodes"))?;
    let script = out.join("run.sh");
    fs::write(&script, RUN)?;
    fs::set_permissions(&script, Permissions::from_mode(0o755))?;
    let size = size(out)?;
    let megabytes = size as f64 / 1e6;
    ensure!(
        size <= HEAVIEST,
        "{} weighs {megabytes:.0} MB, expected at most {} MB: fewer episodes would do",
        out.display(),
        HEAVIEST / 1_000_000
    );
    eprintln!("{}: {megabytes:.1} MB; there, sh run.sh trains", out.display());
    Ok(())
}

/// Copies a file, or a folder of files.
fn copy(from: &Path, to: &Path) -> Result<()> {
    if from.is_file() {
        fs::copy(from, to)?;
        return Ok(());
    }
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        copy(&entry.path(), &to.join(entry.file_name()))?;
    }
    Ok(())
}

fn size(path: &Path) -> Result<u64> {
    if path.is_file() {
        return Ok(fs::metadata(path)?.len());
    }
    fs::read_dir(path)?.map(|entry| size(&entry?.path())).sum()
}
