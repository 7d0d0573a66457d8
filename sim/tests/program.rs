//! The program as people and other programs use it.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

use std::{
    path::Path,
    process::{Command, Output},
};

const PROGRAM: &str = env!("CARGO_BIN_EXE_gatsbi-sim");

fn run(arguments: &[&str], folder: &Path) -> Output {
    Command::new(PROGRAM).args(arguments).current_dir(folder).output().unwrap()
}

fn text(bytes: &[u8]) -> &str {
    str::from_utf8(bytes).unwrap()
}

#[test]
fn a_data_set_is_made_looked_at_and_compared() {
    let folder = tempfile::tempdir().unwrap();
    let made = run(
        &[
            "generate",
            "--scene",
            "balls3",
            "--episodes",
            "2",
            "--seed",
            "1",
            "--out",
            "set",
            "--size",
            "16",
        ],
        folder.path(),
    );
    assert!(made.status.success(), "{made:?}");
    assert!(text(&made.stdout).starts_with("set: 2 episodes, 200 frames, "), "{made:?}");
    let looked = run(&["look", "set", "--episodes", "1"], folder.path());
    assert!(looked.status.success(), "{looked:?}");
    assert!(text(&looked.stdout).contains("width of an object, pixels"), "{looked:?}");
    assert_eq!(image::image_dimensions(folder.path().join("set.png")).unwrap(), (480, 96));
    let hashes = run(&["hashes", "set"], folder.path());
    let lines: Vec<Vec<_>> =
        text(&hashes.stdout).lines().map(|line| line.split(' ').collect()).collect();
    assert_eq!(lines.iter().map(|line| line[0]).collect::<Vec<_>>(), ["0", "1"]);
    assert!(lines.iter().all(|line| line[2].len() == 64), "{hashes:?}");
}

#[test]
fn what_is_missing_is_said_in_one_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new(PROGRAM);
    command.args([
        "generate",
        "--scene",
        "push1",
        "--episodes",
        "1",
        "--seed",
        "1",
        "--out",
        "set",
    ]);
    // EGL finds no driver there.
    let output = command
        .env("__EGL_VENDOR_LIBRARY_FILENAMES", folder.path())
        .current_dir(folder.path())
        .output()
        .unwrap();
    assert!(!output.status.success());
    let said = text(&output.stderr);
    assert_eq!(said.lines().count(), 1, "{said}");
    assert!(said.contains("apt install libegl1 libgl1-mesa-dri"), "{said}");
    assert!(!folder.path().join("set").exists());

    let unknown = run(&["serve", "--scene", "push3"], folder.path());
    assert!(text(&unknown.stderr).contains("there is no scene `push3`"), "{unknown:?}");
    let nothing = run(&["look", "nothing"], folder.path());
    assert!(text(&nothing.stderr).starts_with("error: "), "{nothing:?}");
}

#[test]
fn python_acts_in_a_scene() {
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join("python");
    let output = Command::new("python3")
        .arg(python.join("tests/test_simulator.py"))
        .env("PYTHONPATH", &python)
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .env("GATSBI_SIM", PROGRAM)
        .output()
        .unwrap();
    let said = text(&output.stderr);
    assert!(output.status.success() && said.contains("Ran 5 tests"), "{said}");
}
