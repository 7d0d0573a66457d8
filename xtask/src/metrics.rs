//! Provides the pretrained networks of the perceptual metrics, for `gatsbi-train eval --perceptual`.
//!
//! Both come in Python packages (`metrics/recipe.json`), in formats that only their frameworks read;
//! `metrics/convert.py` makes one safetensors file of them.

use std::process::Command;

use anyhow::{Result, ensure};
use fs_err as fs;

use crate::setup;

const RECIPE: &str = include_str!("../metrics/recipe.json");
const CONVERT: &str = include_str!("../metrics/convert.py");

/// The file that users name.
const FILE: &str = "perceptual.safetensors";

/// Provides the file unless it is there, and prints where it lies.
#[expect(clippy::print_stdout, reason = "the path is the command's result")]
pub(crate) fn provide() -> Result<()> {
    let cache = setup::cache()?;
    let folder = cache.join("metrics");
    setup::fill(&cache, &folder, RECIPE, |unfinished| {
        let packages = ["alex_shift_tolerant.pth", "i3d-kinetics-400.ckpt"];
        let status = Command::new("python3")
            .args(["-c", CONVERT])
            .args(packages)
            .arg(FILE)
            .current_dir(unfinished)
            .status()?;
        ensure!(status.success(), "the weights of the metrics could not be converted");
        for package in packages {
            fs::remove_file(unfinished.join(package))?;
        }
        Ok(())
    })?;
    println!("{}", folder.join(FILE).display());
    Ok(())
}
