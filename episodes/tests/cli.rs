//! The program as a user runs it.

use std::{
    path::{Path, PathBuf},
    process::{Command, Output},
};

use serde_json::Value;

fn sample() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("samples/push1-heldout.parquet")
}

fn run(args: &[&str], path: &Path) -> Output {
    let program = env!("CARGO_BIN_EXE_gatsbi-episodes");
    Command::new(program).args(args).arg(path).output().expect("the program starts")
}

#[test]
fn split_copies_the_episodes_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("last two");
    let split = run(&["split", "--last", "2", "--out", out.to_str().unwrap()], &sample());
    assert!(split.status.success(), "{split:?}");
    let line = String::from_utf8(split.stdout).unwrap();
    assert!(line.contains("last two: episodes 2, frames 80, shards 1, "), "{line}");
    assert_eq!((line.lines().count(), split.stderr.len()), (1, 0));

    let info = run(&["info", "--json", "--verify"], &out);
    assert!(info.status.success(), "{info:?}");
    let info: Value = serde_json::from_slice(&info.stdout).unwrap();
    assert_eq!((&info["episodes"], &info["frames"]), (&2.into(), &80.into()));
    assert_eq!((&info["first_id"], &info["last_id"]), (&298.into(), &299.into()));
    assert_eq!(info["dataset"]["actions"][0]["name"], "panda_joint1");
    assert_eq!(info["actions"].as_array().unwrap().len(), 7);
    assert_eq!(info["object_counts"]["3"], 1);

    let again = run(&["split", "--last", "2", "--out", out.to_str().unwrap()], &sample());
    assert!(!again.status.success());
    let message = String::from_utf8(again.stderr).unwrap();
    assert!(message.contains("exists and is not an empty folder"), "{message}");
}

#[test]
fn join_puts_data_sets_together_and_refuses_others() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    let (two, both) = (path("two"), path("both"));
    assert!(run(&["split", "--last", "2", "--out", &two], &sample()).status.success());
    let joined = run(&["join", "--out", &both, &two], &sample());
    assert!(joined.status.success(), "{joined:?}");
    let info = run(&["info", "--json", "--verify"], Path::new(&both));
    let info: Value = serde_json::from_slice(&info.stdout).unwrap();
    assert_eq!(
        (&info["episodes"], &info["first_id"], &info["last_id"]),
        (&8.into(), &0.into(), &7.into())
    );

    let roll = sample().with_file_name("roll-heldout.parquet");
    let refused = run(&["join", "--out", &path("none"), &two], &roll);
    assert!(!refused.status.success());
    let message = String::from_utf8(refused.stderr).unwrap();
    let expected = "roll-heldout.parquet: frame_period_seconds is 0.15, expected 0.2 as in ";
    assert!(message.contains(&format!("{expected}{two}")), "{message}");
    assert!(!Path::new(&path("none")).exists());
}

#[test]
fn info_prints_what_a_person_wants_to_know() {
    let info = run(&["info"], &sample());
    assert!(info.status.success(), "{info:?}");
    let text = String::from_utf8(info.stdout).unwrap();
    for part in ["64x64", "240 frames", "ids 294 to 299", "panda_joint7", "rad/s", "MuJoCo"] {
        assert!(text.contains(part), "no {part} in {text}");
    }
}

#[test]
fn a_failure_prints_its_causes_once() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("cut.parquet");
    fs_err::write(&file, "PAR1 and no more").unwrap();
    let info = run(&["info"], &file);
    assert_eq!(info.status.code(), Some(1));
    let message = String::from_utf8(info.stderr).unwrap();
    assert!(message.contains("cut.parquet is not a complete Parquet file"), "{message}");
    assert!(message.contains("Caused by:") && !message.contains("panicked"), "{message}");
}
