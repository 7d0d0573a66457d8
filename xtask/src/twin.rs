//! The model's twin in PyTorch (`tests/reference`): its Python, and the agreement of the two at full size.
//!
//! What is compared, and how closely, is said in `tests/reference/README.md`; the comparison itself is a Rust test of
//! the models crate.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context as _, Result, ensure};

use crate::libtorch::VERSION;
use crate::setup;

const FOLDER: &str = ".venv-twin";
const SOURCES: &str = "tests/reference";

/// Records the twin at full size and compares the Rust model with it; prints the table of differences.
pub(crate) fn agree(root: &Path, presets: &[String]) -> Result<()> {
    setup::ensure_set_up(root)?;
    let mut command = Command::new(python(root)?);
    command.args(["-m", "gatsbi_twin.live"]).args(presets).current_dir(root);
    let status = command.status()?;
    ensure!(status.success(), "the model and its twin do not agree, or could not be compared");
    Ok(())
}

/// The Python that has the twin and the torch it runs on; made by the first call.
pub(crate) fn python(root: &Path) -> Result<PathBuf> {
    let python = root.join(FOLDER).join("bin/python");
    if is_complete(&python) {
        return Ok(python);
    }
    eprintln!("making {FOLDER}: torch {VERSION} and the twin, as pip is set to find them");
    run(Command::new("python3").args(["-m", "venv", FOLDER]).current_dir(root)).context(
        "no virtual environment could be made (on Debian and Ubuntu: apt install python3-venv)",
    )?;
    let install = ["-m", "pip", "install", "--disable-pip-version-check", "--editable", SOURCES];
    run(Command::new(&python).args(install).current_dir(root))?;
    ensure!(is_complete(&python), "{FOLDER} holds no torch {VERSION} with the twin after all");
    Ok(python)
}

fn is_complete(python: &Path) -> bool {
    const CHECK: &str = "import sys, gatsbi_twin.model, torch\n\
                         sys.exit(torch.__version__.split('+')[0] != sys.argv[1])";
    let mut command = Command::new(python);
    command.args(["-c", CHECK, VERSION]).stdout(Stdio::null()).stderr(Stdio::null());
    python.exists() && command.status().is_ok_and(|status| status.success())
}

fn run(command: &mut Command) -> Result<()> {
    let name = command.get_program().to_owned();
    let status = command.status().with_context(|| format!("{} cannot be run", name.display()))?;
    ensure!(status.success(), "{} failed ({status})", name.display());
    Ok(())
}
