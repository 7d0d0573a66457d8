//! What a usable libtorch is, and whether the user's environment names one.
//!
//! The rules are those of torch-sys's build script, which finds libtorch for the other crates:
//! `LIBTORCH_USE_PYTORCH` first, then `LIBTORCH` with `LIBTORCH_INCLUDE` and `LIBTORCH_LIB`. Checking here
//! turns its C++ errors, minutes into a build, into one sentence at the start. Providing a libtorch is the
//! business of [`crate::setup`].

use std::env;
use std::env::consts::{DLL_PREFIX, DLL_SUFFIX};
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context as _, Result, bail, ensure};
use fs_err as fs;

/// The one version that our tch works with.
pub(crate) const VERSION: &str = "2.11.0";

/// The link in the repository's root that `.cargo/config.toml` sets `LIBTORCH` to.
pub(crate) const LINK: &str = ".libtorch";

const VERSION_HEADER: &str = "include/torch/headeronly/version.h";
const API_HEADER: &str = "include/torch/csrc/api/include/torch/torch.h";
const LIBRARIES: [&str; 3] = ["torch", "torch_cpu", "c10"];

/// Returns the folder of the libtorch that the user's environment names, checked; nothing if it names none.
pub(crate) fn of_the_user(root: &Path) -> Result<Option<PathBuf>> {
    if env::var_os("LIBTORCH_USE_PYTORCH").is_some() {
        let usable = of_python().and_then(|folder| check(&folder, &folder).map(|()| folder));
        return usable.map(Some).context(
            "LIBTORCH_USE_PYTORCH leads to no usable libtorch (unset it to have one provided)",
        );
    }
    let Some(folder) = env::var_os("LIBTORCH").map(PathBuf::from) else { return Ok(None) };
    if is_our_link(root, &folder) {
        return Ok(None);
    }
    ensure!(folder.is_absolute(), "LIBTORCH must be an absolute path, not {}", folder.display());
    let part = |name| env::var_os(name).map_or_else(|| folder.clone(), PathBuf::from);
    check(&part("LIBTORCH_INCLUDE"), &part("LIBTORCH_LIB"))
        .context("LIBTORCH names no usable libtorch (unset it to have one provided)")?;
    Ok(Some(folder))
}

/// Checks that `headers/include` and `libraries/lib` hold a complete libtorch of our version.
pub(crate) fn check(headers: &Path, libraries: &Path) -> Result<()> {
    let needed = [VERSION_HEADER, API_HEADER].map(|header| headers.join(header));
    for path in needed.into_iter().chain(LIBRARIES.map(|name| libraries.join(library(name)))) {
        ensure!(
            path.exists(),
            "this is not a complete libtorch {VERSION}: {} is missing",
            path.display()
        );
    }
    let found = version_in(&fs::read_to_string(headers.join(VERSION_HEADER))?);
    let bypass = env::var_os("LIBTORCH_BYPASS_VERSION_CHECK").is_some();
    ensure!(
        bypass || found == VERSION,
        "libtorch {VERSION} is needed, and {} holds {found}",
        headers.display()
    );
    Ok(())
}

fn library(name: &str) -> String {
    format!("lib/{DLL_PREFIX}{name}{DLL_SUFFIX}")
}

/// Reads `major.minor.patch` from the text of libtorch's version header.
fn version_in(header: &str) -> String {
    let part = |name: &str| {
        header
            .lines()
            .find_map(|line| line.strip_prefix("#define TORCH_VERSION_")?.strip_prefix(name))
            .map_or("?", str::trim)
    };
    ["MAJOR ", "MINOR ", "PATCH "].map(part).join(".")
}

/// The folder of the `torch` package that torch-sys will ask for its paths.
fn of_python() -> Result<PathBuf> {
    let python = if env::var_os("VIRTUAL_ENV").is_some() { "python" } else { "python3" };
    let output = Command::new(python)
        .args(["-c", "import os, torch; print(os.path.dirname(torch.__file__))"])
        .output()
        .with_context(|| format!("`{python}` cannot be run"))?;
    if !output.status.success() {
        bail!("`{python}` cannot import torch: install torch {VERSION} for it");
    }
    Ok(PathBuf::from(String::from_utf8(output.stdout)?.trim()))
}

/// Whether this value of `LIBTORCH` comes from the repository's own cargo configuration.
fn is_our_link(root: &Path, folder: &Path) -> bool {
    let parent = folder.parent().and_then(|parent| parent.canonicalize().ok());
    folder.ends_with(LINK) && parent.is_some() && parent == root.canonicalize().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "#pragma once\n#define TORCH_VERSION_MAJOR 2\n\n\
        #define TORCH_VERSION_MINOR 11\n#define TORCH_VERSION_PATCH 0\n#define TORCH_VERSION \\\n";

    fn folder_with(header: &str) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let libraries = LIBRARIES.map(library);
        for path in
            [VERSION_HEADER, API_HEADER].into_iter().chain(libraries.iter().map(String::as_str))
        {
            let path = folder.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, header).unwrap();
        }
        folder
    }

    #[test]
    fn a_complete_folder_of_our_version_passes() {
        let folder = folder_with(HEADER);
        check(folder.path(), folder.path()).unwrap();
    }

    #[test]
    fn another_version_is_named() {
        let folder = folder_with(&HEADER.replace("11", "10"));
        let error = check(folder.path(), folder.path()).unwrap_err().to_string();
        assert!(error.starts_with("libtorch 2.11.0 is needed"), "{error}");
        assert!(error.ends_with("holds 2.10.0"), "{error}");
    }

    #[test]
    fn a_missing_file_is_named() {
        for missing in [VERSION_HEADER, API_HEADER, &library("c10")] {
            let folder = folder_with(HEADER);
            fs::remove_file(folder.path().join(missing)).unwrap();
            let error = check(folder.path(), folder.path()).unwrap_err().to_string();
            assert!(error.contains(missing) && error.ends_with("is missing"), "{error}");
        }
    }

    #[test]
    fn only_the_link_in_the_root_is_ours() {
        let root = tempfile::tempdir().unwrap();
        assert!(is_our_link(root.path(), &root.path().join(LINK)));
        assert!(!is_our_link(root.path(), &root.path().join("libtorch")));
        assert!(!is_our_link(root.path(), Path::new("/").join(LINK).as_path()));
    }
}
