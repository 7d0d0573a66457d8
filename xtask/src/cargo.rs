//! The checks that cargo runs: tests, lints, formatting. Each command is printed before it starts.
//!
//! One profile only (dev), so that torch-sys, which takes minutes, compiles once for all of them.

use std::env;
use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Result, ensure};

use crate::setup;

/// Runs every test of the workspace, doctests included; `args` go to the test binaries.
pub(crate) fn test(root: &Path, args: &[String]) -> Result<()> {
    setup::ensure_set_up(root)?;
    let mut command = cargo(root, "test --workspace --locked");
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

fn run(command: &mut Command) -> Result<()> {
    let mut line = String::from("cargo");
    for argument in command.get_args() {
        line.push(' ');
        line.push_str(&argument.to_string_lossy());
    }
    eprintln!("$ {line}");
    let status = command.status()?;
    ensure!(status.success(), "`{line}` failed");
    Ok(())
}
