//! Provides libtorch in a cache shared by all checkouts, and points the repository's `.libtorch` at it; libmujoco
//! comes the same way, see [`crate::mujoco`].
//!
//! Which files of which wheels make up a libtorch is written in `libtorch/cpu.json` and `libtorch/cuda.json`,
//! the recipes; `libtorch/fetch.py` downloads and unpacks them. Here they become a folder that torch-sys
//! accepts. A folder is complete when it holds the recipe it was made by, which is written last, so an
//! interrupted set-up is never taken for a finished one. What makes a libtorch usable is in
//! [`crate::libtorch`].

use std::env;
use std::env::consts::{ARCH, OS};
use std::fs::{File, TryLockError};
use std::io::Write as _;
#[cfg(unix)]
use std::os::unix::fs::symlink;
#[cfg(windows)]
use std::os::windows::fs::symlink_dir as symlink;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context as _, Result, bail, ensure};
use fs_err as fs;

use crate::cargo;
use crate::libtorch::{self, LINK, VERSION};
use crate::mujoco;

const FETCH: &str = include_str!("../libtorch/fetch.py");
const RECIPE: &str = "recipe.json";

/// Which build of libtorch.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Variant {
    /// The libraries that a CPU needs.
    Cpu,
    /// Those of CUDA as well.
    Cuda,
}

impl Variant {
    fn for_this_machine() -> Self {
        if Path::new("/proc/driver/nvidia/version").exists() { Self::Cuda } else { Self::Cpu }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
        }
    }

    fn recipe(self) -> &'static str {
        match self {
            Self::Cpu => include_str!("../libtorch/cpu.json"),
            Self::Cuda => include_str!("../libtorch/cuda.json"),
        }
    }

    fn is_complete_in(self, folder: &Path) -> bool {
        is_made_by(folder, self.recipe())
    }
}

/// Provides the wanted libtorch, or the one that suits this machine, unless the user brought one.
pub(crate) fn setup(root: &Path, wanted: Option<Variant>) -> Result<()> {
    mujoco::set_up(root)?;
    if let Some(folder) = libtorch::of_the_user(root)? {
        eprintln!("libtorch {VERSION} of your environment is used: {}", folder.display());
        return Ok(());
    }
    let variant = wanted.unwrap_or_else(Variant::for_this_machine);
    let cache = cache()?;
    let folder = cache.join(format!("libtorch-{VERSION}-{}", variant.name()));
    provide(variant, &cache, &folder)?;
    link(root, &folder.join("torch"))?;
    eprintln!("libtorch {VERSION} ({}) is ready: {}", variant.name(), folder.display());
    Ok(())
}

/// Sets up unless a libtorch is there already: the user's own, or either variant of ours.
pub(crate) fn ensure_set_up(root: &Path) -> Result<()> {
    mujoco::set_up(root)?;
    let linked = fs::read_link(root.join(LINK)).ok();
    let is_complete =
        |folder: &Path| [Variant::Cpu, Variant::Cuda].iter().any(|v| v.is_complete_in(folder));
    if libtorch::of_the_user(root)?.is_some()
        || linked.as_deref().and_then(Path::parent).is_some_and(is_complete)
    {
        return Ok(());
    }
    setup(root, None)
}

fn provide(variant: Variant, cache: &Path, folder: &Path) -> Result<()> {
    if variant.is_complete_in(folder) {
        return Ok(());
    }
    check_platform(OS, ARCH, cfg!(target_env = "gnu"))?;
    check_compiler()?;
    fill(cache, folder, variant.recipe(), |unfinished| {
        let torch = unfinished.join("torch");
        if !torch.join("lib/libtorch.so").exists() {
            make_libtorch_so(&torch.join("lib"))?;
        }
        fs::write(torch.join("build-version"), format!("{VERSION}\n"))?;
        libtorch::check(&torch, &torch)
    })
}

/// Makes `folder` in the cache from a recipe, unless it is there: downloads, lets `finish` work on what was unpacked,
/// and gives it its name when it is whole.
pub(crate) fn fill(
    cache: &Path,
    folder: &Path,
    recipe: &str,
    finish: impl FnOnce(&Path) -> Result<()>,
) -> Result<()> {
    let is_complete = || is_made_by(folder, recipe);
    if is_complete() {
        return Ok(());
    }
    fs::create_dir_all(cache)?;
    let _lock = lock(cache)?;
    if is_complete() {
        return Ok(());
    }
    let unfinished = folder.with_added_extension("unfinished");
    fetch(recipe, &cache.join("downloads"), &unfinished)?;
    finish(&unfinished)?;
    fs::write(unfinished.join(RECIPE), recipe)?;
    if folder.exists() {
        fs::remove_dir_all(folder)?;
    }
    fs::rename(unfinished, folder)?;
    Ok(())
}

/// Whether a folder was made, and finished, from that recipe.
fn is_made_by(folder: &Path, recipe: &str) -> bool {
    fs::read_to_string(folder.join(RECIPE)).is_ok_and(|made_by| made_by == recipe)
}

fn check_platform(os: &str, arch: &str, glibc: bool) -> Result<()> {
    ensure!(
        os == "linux" && arch == "x86_64" && glibc,
        "libtorch is provided for x86_64 Linux with glibc only: install torch {VERSION} and set \
         LIBTORCH_USE_PYTORCH=1, or set LIBTORCH to an unpacked libtorch {VERSION}"
    );
    Ok(())
}

/// The C++ compiler that the cc crate will use for torch-sys.
fn compiler() -> Command {
    let words = env::var("CXX").unwrap_or_else(|_| "c++".to_owned());
    let mut words = words.split_whitespace();
    let mut command = Command::new(words.next().unwrap_or("c++"));
    command.args(words);
    command
}

fn check_compiler() -> Result<()> {
    let answer = compiler().arg("--version").output();
    ensure!(
        answer.is_ok_and(|answer| answer.status.success()),
        "there is no C++ compiler (`{}`): install one (on Debian and Ubuntu: apt install g++)",
        compiler().get_program().display()
    );
    Ok(())
}

/// Keeps a second set-up out of the cache until the returned file is dropped.
pub(crate) fn lock(cache: &Path) -> Result<File> {
    let path = cache.join("lock");
    let file = File::create(&path).with_context(|| format!("cannot write {}", path.display()))?;
    match file.try_lock() {
        Err(TryLockError::WouldBlock) => {
            eprintln!("another set-up is at work in {}: waiting for it", cache.display());
            file.lock()?;
        }
        answer => answer?,
    }
    Ok(file)
}

/// Downloads and unpacks what `recipe` lists into `target`.
pub(crate) fn fetch(recipe: &str, downloads: &Path, target: &Path) -> Result<()> {
    let mut python = Command::new("python3")
        .args(["-", recipe])
        .args([downloads, target])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .context(
            "`python3` cannot be run: install Python 3 with pip (on Debian and Ubuntu: apt install \
             python3 python3-pip)",
        )?;
    let mut stdin = python.stdin.take().context("python3 has no standard input")?;
    let written = stdin.write_all(FETCH.as_bytes());
    drop(stdin);
    let output = python.wait_with_output()?;
    let sentence = String::from_utf8_lossy(&output.stdout);
    match (output.status.success(), sentence.trim()) {
        (true, _) => written.context("python3 did not read its script"),
        (false, "") => bail!("the download failed (python3: {})", output.status),
        (false, sentence) => bail!("{sentence}"),
    }
}

/// Makes the library that torch-sys links by name: in the trimmed folder it only leads to the two real ones.
fn make_libtorch_so(lib: &Path) -> Result<()> {
    let status = compiler()
        .args(["-shared", "-nostdlib", "-Wl,-soname,libtorch.so", "-Wl,-rpath,$ORIGIN"])
        .args(["-Wl,--no-as-needed", "-L.", "-ltorch_cpu", "-lc10", "-o", "libtorch.so"])
        .current_dir(lib)
        .status()?;
    ensure!(status.success(), "the C++ compiler could not link {}/libtorch.so", lib.display());
    Ok(())
}

/// Points `.libtorch` at `target`.
fn link(root: &Path, target: &Path) -> Result<()> {
    let link = root.join(LINK);
    let before = fs::read_link(&link).ok();
    if before.as_deref() == Some(target) {
        return Ok(());
    }
    if before.is_some() {
        // Cargo sees the link's name only, and would keep what was built against the other libtorch.
        cargo::clean(root, "torch-sys")?;
    }
    replace_link(&link, target)
}

/// Points `link` at `target` in one step.
pub(crate) fn replace_link(link: &Path, target: &Path) -> Result<()> {
    if fs::read_link(link).is_ok_and(|before| before == target) {
        return Ok(());
    }
    let fresh = link.with_added_extension("new");
    if fresh.is_symlink() {
        fs::remove_file(&fresh)?;
    }
    symlink(target, &fresh).with_context(|| format!("cannot make the link {}", fresh.display()))?;
    fs::rename(fresh, link)?;
    Ok(())
}

/// The folder that all checkouts share.
pub(crate) fn cache() -> Result<PathBuf> {
    let folder = |name| env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let cache = folder("GATSBI_CACHE")
        .or_else(|| Some(folder("XDG_CACHE_HOME")?.join("gatsbi")))
        .or_else(|| Some(folder("HOME")?.join(".cache/gatsbi")))
        .context("there is no home folder to cache libraries in: set GATSBI_CACHE to a folder")?;
    std::path::absolute(&cache).with_context(|| format!("{} is no path", cache.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_platforms_are_told_what_to_set() {
        check_platform("linux", "x86_64", true).unwrap();
        for (os, arch, glibc) in
            [("macos", "aarch64", false), ("linux", "aarch64", true), ("linux", "x86_64", false)]
        {
            let sentence = check_platform(os, arch, glibc).unwrap_err().to_string();
            assert!(sentence.contains("LIBTORCH_USE_PYTORCH=1"), "{sentence}");
            assert!(sentence.contains("or set LIBTORCH to"), "{sentence}");
        }
    }

    #[test]
    fn a_folder_is_complete_by_the_recipe_it_holds() {
        let folder = tempfile::tempdir().unwrap();
        assert!(!Variant::Cpu.is_complete_in(folder.path()));
        fs::write(folder.path().join(RECIPE), Variant::Cuda.recipe()).unwrap();
        assert!(!Variant::Cpu.is_complete_in(folder.path()));
        assert!(Variant::Cuda.is_complete_in(folder.path()));
    }

    #[test]
    fn an_abandoned_link_is_replaced() {
        let root = tempfile::tempdir().unwrap();
        symlink("abandoned", root.path().join(".libtorch.new")).unwrap();
        let target = root.path().join("cache/torch");
        link(root.path(), &target).unwrap();
        assert_eq!(fs::read_link(root.path().join(LINK)).unwrap(), target);
        assert!(!root.path().join(".libtorch.new").is_symlink());
    }
}
