//! The tarball: programs, the libraries that they need, a checkpoint, settings, and the licences of all of it, in a
//! folder that runs wherever it is unpacked.
//!
//! The server finds its libraries by `$ORIGIN/../lib`, which its build puts beside the path of this machine's libtorch
//! (`models/link.rs`); that path is cut out here, so that nothing is looked for where it was built.

use std::collections::BTreeMap;
use std::env::consts::{ARCH, OS};
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context as _, Result, bail, ensure};
use clap::Args;
use fs_err as fs;
use serde_json::Value;

use crate::cargo;
use crate::libtorch;
use crate::setup;

const CHECKPOINTS: &str = "models/checkpoints";
const RELATIVE: &str = "$ORIGIN/../lib";

/// Files that are taken as they are, with their places in the package.
const FILES: &[(&str, &str)] = &[
    ("server/gatsbi.toml", "etc/gatsbi.toml"),
    ("docker/gatsbi.service", "systemd/gatsbi.service"),
    ("docker/prometheus/alerts.yml", "share/prometheus/alerts.yml"),
    ("docker/grafana/dashboards/gatsbi.json", "share/grafana/gatsbi.json"),
    ("docs/metrics.md", "share/doc/metrics.md"),
    ("docs/operating.md", "share/doc/operating.md"),
    ("LICENSE-APACHE", "licenses/LICENSE-APACHE"),
    ("LICENSE-MIT", "licenses/LICENSE-MIT"),
];

#[derive(Args)]
pub(crate) struct Arguments {
    /// Profile to build in; release compiles torch-sys once more, which takes minutes
    #[arg(long, default_value = "release")]
    profile: String,
    /// Leave the files in this folder, and make no tarball
    #[arg(long, value_name = "DIR")]
    folder: Option<PathBuf>,
}

/// Makes the package; prints where it is.
pub(crate) fn package(root: &Path, arguments: &Arguments) -> Result<()> {
    setup::ensure_set_up(root)?;
    let build = format!(
        "build --workspace --locked --bin gatsbi-server --bin gatsbi --profile {}",
        arguments.profile
    );
    let programs = cargo::build(root, &build)?;
    let libtorch = libtorch::of_the_user(root)?.unwrap_or_else(|| root.join(libtorch::LINK));
    let libraries = libraries(&libtorch)?;
    let cuda = libraries.keys().any(|name| name.starts_with("libtorch_cuda."));
    let name =
        format!("gatsbi-{}-{ARCH}-{OS}-{}", version(root)?, if cuda { "cuda" } else { "cpu" });
    let made = root.join("target/package");
    let folder = arguments.folder.clone().unwrap_or_else(|| made.join(&name));
    // What an earlier package left must not get into this one.
    if folder.exists() {
        ensure!(
            folder.join("licenses").exists() || fs::read_dir(&folder)?.next().is_none(),
            "{} is there already, and is no package",
            folder.display()
        );
        fs::remove_dir_all(&folder)?;
    }

    for program in ["gatsbi-server", "gatsbi"] {
        let file = folder.join("bin").join(program);
        copy(programs.named(program)?, &file)?;
        strip(&file)?;
        make_relocatable(&file)?;
    }
    for (name, path) in &libraries {
        copy(path, &folder.join("lib").join(name))?;
    }
    for entry in fs::read_dir(root.join(CHECKPOINTS))? {
        let path = entry?.path();
        let name = path.file_name().context("a checkpoint has no name")?;
        copy(&path, &folder.join("share/checkpoints").join(name))?;
    }
    for (from, to) in FILES {
        copy(&root.join(from), &folder.join(to))?;
    }
    fs::write(folder.join("licenses/THIRD-PARTY.txt"), third_parties(root)?)?;

    if arguments.folder.is_some() {
        eprintln!("{}", folder.display());
        return Ok(());
    }
    let tarball = made.join(format!("{name}.tar.gz"));
    let mut tar = Command::new("tar");
    // The same files give the same tarball, but for what the compiler did.
    tar.args(["--create", "--gzip", "--sort=name", "--owner=0", "--group=0", "--numeric-owner"]);
    tar.args(["--mtime=@0", "--file"]).arg(&tarball).arg("--directory").arg(&made).arg(&name);
    ensure!(tar.status()?.success(), "tar cannot make {}", tarball.display());
    eprintln!("{}: {} bytes", tarball.display(), fs::metadata(&tarball)?.len());
    Ok(())
}

/// The shared libraries of a libtorch by name: its own, and those of the wheels beside it.
fn libraries(libtorch: &Path) -> Result<BTreeMap<String, PathBuf>> {
    let real = libtorch.canonicalize()?;
    let mut folders = vec![real.join("lib")];
    let wheels = real.parent().map(|parent| parent.join("nvidia"));
    if let Some(wheels) = wheels.filter(|wheels| wheels.is_dir()) {
        for wheel in fs::read_dir(wheels)? {
            folders.push(wheel?.path().join("lib"));
        }
    }
    let mut libraries = BTreeMap::new();
    for folder in folders.into_iter().filter(|folder| folder.is_dir()) {
        for file in fs::read_dir(folder)? {
            let path = file?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            // Python's half of torch is of no use to us.
            if name.contains(".so") && !name.contains("python") {
                libraries.insert(name, path);
            }
        }
    }
    ensure!(libraries.contains_key("libtorch.so"), "there is no libtorch.so in {}", real.display());
    Ok(libraries)
}

fn copy(from: &Path, to: &Path) -> Result<()> {
    fs::create_dir_all(to.parent().context("a file lies in a folder")?)?;
    fs::copy(from, to)?;
    Ok(())
}

/// Takes debugging information away, where `strip` is there.
fn strip(file: &Path) -> Result<()> {
    let status = Command::new("strip").arg("--strip-unneeded").arg(file).status();
    let status = status.context("strip cannot be run: it comes with the C++ compiler")?;
    ensure!(status.success(), "strip failed on {}", file.display());
    Ok(())
}

/// Cuts the path of this machine's libtorch out of where a program looks for libraries.
fn make_relocatable(file: &Path) -> Result<()> {
    let mut bytes = Vec::new();
    fs::File::open(file)?.read_to_end(&mut bytes)?;
    if !cut_search_path(&mut bytes)? {
        return Ok(());
    }
    let permissions = fs::metadata(file)?.permissions();
    fs::write(file, bytes)?;
    fs::set_permissions(file, permissions)?;
    Ok(())
}

/// Leaves `$ORIGIN/../lib` alone of a search path that ends with it; false if there is none.
fn cut_search_path(elf: &mut [u8]) -> Result<bool> {
    let ending = format!(":{RELATIVE}\0");
    let found: Vec<usize> = elf
        .windows(ending.len())
        .enumerate()
        .filter_map(|(at, window)| (window == ending.as_bytes()).then_some(at))
        .collect();
    let at = match found[..] {
        [] => return Ok(false),
        [at] => at,
        _ => bail!("there is more than one search path that ends with {RELATIVE}"),
    };
    let start = elf[..at].iter().rposition(|byte| *byte == 0).map_or(0, |zero| zero + 1);
    let end = at + ending.len();
    elf[start..end].fill(0);
    elf[start..start + RELATIVE.len()].copy_from_slice(RELATIVE.as_bytes());
    Ok(true)
}

fn version(root: &Path) -> Result<String> {
    let manifest = fs::read_to_string(root.join("Cargo.toml"))?;
    let line = manifest.lines().find_map(|line| line.strip_prefix("version = \""));
    let version = line.and_then(|line| line.strip_suffix('"'));
    Ok(version.context("Cargo.toml names no version of the workspace")?.to_owned())
}

/// Names, versions and licences of the crates that are linked in, with the texts of their licences.
fn third_parties(root: &Path) -> Result<String> {
    let tree = |package: &str| -> Result<Vec<String>> {
        let arguments = "tree --locked --edges normal --prefix none --format {p} --package";
        let output = Command::new("cargo")
            .args(arguments.split(' '))
            .arg(package)
            .current_dir(root)
            .output()?;
        ensure!(output.status.success(), "cargo tree failed on {package}");
        let text = String::from_utf8(output.stdout)?;
        let named = text.lines().filter_map(|line| {
            let mut words = line.split(' ');
            Some(format!("{} {}", words.next()?, words.next()?.trim_start_matches('v')))
        });
        Ok(named.collect())
    };
    let mut linked = tree("gatsbi-server")?;
    linked.extend(tree("gatsbi-client")?);
    let output = Command::new("cargo")
        .args(["metadata", "--locked", "--format-version", "1"])
        .current_dir(root)
        .output()?;
    ensure!(output.status.success(), "cargo metadata failed");
    let metadata: Value = serde_json::from_slice(&output.stdout)?;
    let mut list = BTreeMap::new();
    let mut texts: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for package in metadata["packages"].as_array().into_iter().flatten() {
        let text = |field: &str| package[field].as_str().unwrap_or_default();
        let name = format!("{} {}", text("name"), text("version"));
        if package["source"].is_null() || !linked.contains(&name) {
            continue;
        }
        list.insert(name.clone(), text("license").to_owned());
        let folder = Path::new(text("manifest_path")).parent().context("a crate has a folder")?;
        for file in fs::read_dir(folder)? {
            let path = file?.path();
            let file = path.file_name().unwrap_or_default().to_string_lossy().to_uppercase();
            let licence = ["LICENSE", "LICENCE", "COPYING", "NOTICE", "UNLICENSE"];
            if path.is_file() && licence.iter().any(|start| file.starts_with(start)) {
                let text = String::from_utf8_lossy(&fs::read(&path)?).trim().to_owned();
                texts.entry(text).or_default().push(name.clone());
            }
        }
    }
    let mut written = String::from(
        "What is in this package and is not ours.\n\nlib/ holds libtorch (BSD-3-Clause, https://github.com/pytorch/pytorch) \
         as PyTorch's wheel has it,\nwith GCC's libgomp (GPL-3.0 with the runtime library exception) and files of NVIDIA's \
         CUDA toolkit\n(NVIDIA Software Licence Agreement). The programs hold these crates:\n\n",
    );
    for (name, licence) in &list {
        written += &format!("{name}: {licence}\n");
    }
    for (text, names) in &texts {
        written += &format!("\n{}\n{}\n\n{text}\n", "-".repeat(80), names.join(", "));
    }
    Ok(written)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_search_path_keeps_its_relative_part_alone() {
        let mut elf = b"x\0/home/me/lib:$ORIGIN/../lib\0rest".to_vec();
        assert!(cut_search_path(&mut elf).unwrap());
        assert_eq!(elf.len(), b"x\0/home/me/lib:$ORIGIN/../lib\0rest".len());
        assert!(elf.starts_with(b"x\0$ORIGIN/../lib\0\0"));
        assert!(elf.ends_with(b"\0rest") && !elf.windows(5).any(|window| window == b"/home"));
        let mut none = b"x\0/lib\0".to_vec();
        assert!(!cut_search_path(&mut none).unwrap());
        let mut two = b"\0a:$ORIGIN/../lib\0b:$ORIGIN/../lib\0".to_vec();
        assert!(cut_search_path(&mut two).is_err());
    }
}
