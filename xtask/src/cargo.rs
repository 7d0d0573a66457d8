//! What cargo does for us: tests, lints, formatting, programs. Each command is printed before it starts.
//!
//! One profile (dev), so that torch-sys, which takes minutes, compiles once for all; only what is measured is built
//! in another.

use std::collections::BTreeMap;
use std::env;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context as _, Result, ensure};

use crate::setup;

/// Programs that cargo has built, by name.
#[derive(Debug)]
pub(crate) struct Programs(BTreeMap<String, PathBuf>);

impl Programs {
    /// The file of a program.
    pub(crate) fn named(&self, name: &str) -> Result<&Path> {
        self.0.get(name).map(PathBuf::as_path).with_context(|| format!("cargo built no {name}"))
    }
}

/// Runs every test of the workspace, doctests included; `args` go to the test binaries.
pub(crate) fn test(root: &Path, args: &[String]) -> Result<()> {
    setup::ensure_set_up(root)?;
    let mut command = cargo(root, "test --workspace --locked");
    let record = env::var_os("GATSBI_PARITY_DIR")
        .map_or_else(|| root.join("../shared/parity"), PathBuf::from);
    if !record.exists() && env::var_os("GATSBI_PARITY").is_none() {
        eprintln!(
            "the full parity record is not here (GATSBI_PARITY_DIR): its committed part runs"
        );
        command.env("GATSBI_PARITY", "skip");
    }
    if !args.is_empty() {
        command.arg("--").args(args);
    }
    run(&mut command)
}

/// Runs every check that needs no test to run.
pub(crate) fn lint(root: &Path) -> Result<()> {
    run(&mut cargo(root, "fmt --all --check"))?;
    setup::ensure_set_up(root)?;
    run(&mut cargo(root, "clippy --workspace --all-targets --locked -- -D warnings"))?;
    run(cargo(root, "doc --workspace --no-deps --document-private-items --locked")
        .env("RUSTDOCFLAGS", "-D warnings"))?;
    let deny =
        cargo(root, "deny --version").stdout(Stdio::null()).stderr(Stdio::null()).status()?;
    if deny.success() {
        run(&mut cargo(root, "deny --locked check bans licenses sources"))
    } else {
        eprintln!("cargo-deny is not installed: bans, licences and sources were not checked");
        Ok(())
    }
}

/// Formats the sources.
pub(crate) fn fmt(root: &Path) -> Result<()> {
    run(&mut cargo(root, "fmt --all"))
}

/// Builds programs and tells where they lie.
pub(crate) fn build(root: &Path, arguments: &str) -> Result<Programs> {
    let mut command = cargo(root, arguments);
    let line = said(&command);
    command.args(["--message-format", "json-render-diagnostics"]);
    let output = command.stderr(Stdio::inherit()).output()?;
    ensure!(output.status.success(), "`{line}` failed");
    let messages = String::from_utf8(output.stdout)?;
    Ok(Programs(messages.lines().filter_map(program).collect()))
}

/// Removes what was built of one package, in both profiles.
pub(crate) fn clean(root: &Path, package: &str) -> Result<()> {
    for profile in ["dev", "release"] {
        run(&mut cargo(root, &format!("clean --package {package} --profile {profile}")))?;
    }
    Ok(())
}

fn cargo(root: &Path, arguments: &str) -> Command {
    let mut command = Command::new("cargo");
    command.args(arguments.split(' ')).current_dir(root);
    // Ours, set by `cargo run`: build scripts that watch them would run again at each change between
    // `cargo xtask test` and `cargo test`.
    for (name, _) in env::vars_os() {
        let name_text = name.to_string_lossy();
        if name_text.starts_with("CARGO_PKG_") || name_text.starts_with("CARGO_MANIFEST_") {
            command.env_remove(&name);
        }
    }
    command
}

/// The program that one of cargo's messages is about.
fn program(message: &str) -> Option<(String, PathBuf)> {
    let message: serde_json::Value = serde_json::from_str(message).ok()?;
    let file = message["executable"].as_str()?;
    Some((message["target"]["name"].as_str()?.to_owned(), file.into()))
}

/// Prints a command as one would type it.
fn said(command: &Command) -> String {
    let mut line = String::from("cargo");
    for argument in command.get_args() {
        line.push(' ');
        line.push_str(&argument.to_string_lossy());
    }
    eprintln!("$ {line}");
    line
}

fn run(command: &mut Command) -> Result<()> {
    let line = said(command);
    let status = command.status()?;
    ensure!(status.success(), "`{line}` failed");
    Ok(())
}
