//! Provides libmujoco, which the simulated scenes link, and points the repository's `.mujoco` at it.
//!
//! It is one library out of a wheel, so the machinery is that of [`crate::setup`]: the same cache, the same
//! downloader, a recipe (`mujoco/recipe.json`) that a complete folder holds. `sim/build.rs` finds the library by
//! the link. A MuJoCo of the user's own, named by `MUJOCO_DYNAMIC_LINK_DIR`, is used instead.

use std::env;
use std::env::consts::{ARCH, OS};
use std::path::{Path, PathBuf};

use anyhow::{Result, ensure};

use crate::setup;

/// The one version that our mujoco-rs binds.
const VERSION: &str = "3.17.0";

/// The link in the repository's root.
const LINK: &str = ".mujoco";

/// The user's variable, which `.cargo/config.toml` otherwise points at a folder of ours.
const VARIABLE: &str = "MUJOCO_DYNAMIC_LINK_DIR";
const OURS: &str = "sim/link";

const RECIPE: &str = include_str!("../mujoco/recipe.json");

/// Provides libmujoco unless it is there already or the user brought one.
pub(crate) fn set_up(root: &Path) -> Result<()> {
    if let Some(folder) = of_the_user(root, env::var_os(VARIABLE).map(PathBuf::from)) {
        let library = folder.join("libmujoco.so");
        ensure!(
            library.exists(),
            "{VARIABLE} names no MuJoCo: there is no {} (unset it to have one provided)",
            library.display()
        );
        return Ok(());
    }
    if !(OS == "linux" && ARCH == "x86_64" && cfg!(target_env = "gnu")) {
        // Only the simulated scenes need it.
        eprintln!(
            "MuJoCo is provided for x86_64 Linux with glibc only: to build gatsbi-sim, set {VARIABLE} to the lib \
             folder of MuJoCo {VERSION}"
        );
        return Ok(());
    }
    let cache = setup::cache()?;
    let folder = cache.join(format!("mujoco-{VERSION}"));
    setup::fill(&cache, &folder, RECIPE, |_| Ok(()))?;
    setup::replace_link(&root.join(LINK), &folder.join("mujoco"))
}

/// The folder that the user's environment names, if it is not the one that the repository's own configuration does.
fn of_the_user(root: &Path, named: Option<PathBuf>) -> Option<PathBuf> {
    let ours = root.join(OURS).canonicalize().ok();
    named.filter(|folder| ours.is_none() || folder.canonicalize().ok() != ours)
}

#[cfg(test)]
mod tests {
    use fs_err as fs;

    use super::*;

    #[test]
    fn only_another_folder_is_the_users() {
        let root = tempfile::tempdir().unwrap();
        let [ours, other] = [OURS, "mujoco/lib"].map(|folder| root.path().join(folder));
        for folder in [&ours, &other] {
            fs::create_dir_all(folder).unwrap();
        }
        assert_eq!(of_the_user(root.path(), Some(ours)), None);
        assert_eq!(of_the_user(root.path(), None), None);
        assert_eq!(of_the_user(root.path(), Some(other.clone())), Some(other));
    }
}
