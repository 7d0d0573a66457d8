//! What every file of the repository keeps to: its length, and no path of somebody's home folder.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

use std::path::{Path, PathBuf};
use std::process::Command;

use fs_err as fs;

const LONGEST: usize = 600;
const SOURCES: &[&str] = &["css", "html", "js", "proto", "py", "rs", "sh", "ts"];

/// Generated files say so in their first lines.
const GENERATED: &[&str] = &["@generated", "DO NOT EDIT"];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
}

/// The files of the repository, those not yet committed among them, with their content.
fn files() -> Vec<(PathBuf, Vec<u8>)> {
    let output = Command::new("git")
        // A checkout may belong to another user than the one who tests it, in a container for instance.
        .args(["-c", "safe.directory=*"])
        .args(["ls-files", "-z", "--cached", "--others", "--exclude-standard"])
        .current_dir(root())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let names = String::from_utf8(output.stdout).unwrap();
    let existing = names.split_terminator('\0').filter(|name| root().join(name).is_file());
    let files: Vec<_> =
        existing.map(|name| (name.into(), fs::read(root().join(name)).unwrap())).collect();
    assert!(files.iter().any(|(name, _)| name == Path::new("Cargo.toml")), "not the repository");
    files
}

fn is_source(name: &Path, text: &str) -> bool {
    let extension = name.extension().and_then(|extension| extension.to_str());
    let script = text.starts_with("#!");
    let generated = |line: &str| GENERATED.iter().any(|mark| line.contains(mark));
    (script || extension.is_some_and(|extension| SOURCES.contains(&extension)))
        && !text.lines().take(5).any(generated)
}

/// Finds a home folder's path in a file: a name in `/home`, say, where an absolute path begins.
fn home_path(content: &[u8]) -> Option<String> {
    let homes = ["home", "Users", "root"].map(|folder| format!("/{folder}/"));
    let part_of_name = |byte: &u8| byte.is_ascii_alphanumeric() || b"._-".contains(byte);
    let slashes = content.iter().enumerate().filter(|(_, byte)| **byte == b'/').map(|(at, _)| at);
    let absolute = slashes.filter(|at| *at == 0 || !part_of_name(&content[at - 1]));
    absolute.map(|at| &content[at..]).find_map(|path| {
        let home = homes.iter().find(|home| path.starts_with(home.as_bytes()))?;
        part_of_name(path.get(home.len())?).then(|| home.clone())
    })
}

#[test]
fn no_source_file_is_too_long() {
    for (name, content) in files() {
        let Ok(text) = str::from_utf8(&content) else { continue };
        let lines = text.lines().count();
        assert!(
            lines <= LONGEST || !is_source(&name, text),
            "{} has {lines} lines, {LONGEST} is the ceiling: one concept a file",
            name.display()
        );
    }
}

#[test]
fn no_file_holds_a_path_of_a_home_folder() {
    for (name, content) in files() {
        if let Some(path) = home_path(&content) {
            panic!("{} holds a path of somebody's home folder: {path}...", name.display());
        }
    }
}

#[test]
fn home_paths_are_told_from_others() {
    let home = |path: &str| format!("/{}/{path}", "home");
    assert!(home_path(home("ann/x").as_bytes()).is_some());
    assert!(home_path(format!("see '{}'", home("ann")).as_bytes()).is_some());
    assert!(home_path(b"\xff\x00/Users\x2fann").is_some());
    assert!(home_path(format!("docs.example{}", home("page")).as_bytes()).is_none());
    assert!(home_path(home("$USER").as_bytes()).is_none());
}
