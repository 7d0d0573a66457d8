//! Who may depend on whom: the arrows between our crates, and the crates that each room must not know.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

use serde_json::Value;

const TORCH: &str = "torch-sys";
const MODELS: &str = "gatsbi-models";
const PICTURES: &str = "gatsbi-pictures";

/// A room: what it may name among our crates, and what must not be in it, however deep.
struct Room {
    package: &'static str,
    may_name: &'static [&'static str],
    must_not_hold: &'static [&'static str],
}

const ROOMS: &[Room] = &[
    Room { package: "gatsbi-proto", may_name: &[], must_not_hold: &["axum", "clap"] },
    Room { package: PICTURES, may_name: &[], must_not_hold: &["prost", "tokio"] },
    Room {
        package: MODELS,
        may_name: &[],
        must_not_hold: &["axum", "clap", "prost", "tokio", "tonic"],
    },
    Room { package: "gatsbi-episodes", may_name: &[], must_not_hold: &["tokio"] },
    Room {
        package: "gatsbi-training",
        may_name: &[MODELS, "gatsbi-episodes"],
        must_not_hold: &["axum", "prost", "tokio", "tonic"],
    },
    Room {
        package: "gatsbi-server",
        may_name: &[MODELS, "gatsbi-episodes", PICTURES, "gatsbi-proto"],
        must_not_hold: &[],
    },
    Room {
        package: "gatsbi-client",
        may_name: &["gatsbi-episodes", PICTURES, "gatsbi-proto"],
        must_not_hold: &[MODELS],
    },
    Room { package: "gatsbi-sim", may_name: &["gatsbi-episodes"], must_not_hold: &[] },
    Room {
        package: "gatsbi-tests",
        may_name: &[
            MODELS,
            "gatsbi-client",
            "gatsbi-episodes",
            "gatsbi-proto",
            "gatsbi-server",
            "gatsbi-sim",
            "gatsbi-training",
        ],
        must_not_hold: &[],
    },
    Room {
        package: "gatsbi-load",
        may_name: &[MODELS, "gatsbi-client", "gatsbi-proto", "gatsbi-server"],
        must_not_hold: &[],
    },
    Room { package: "xtask", may_name: &[], must_not_hold: &[] },
];

/// Our packages, each with those of ours that its manifest names (development and build dependencies too).
fn arrows() -> BTreeMap<String, BTreeSet<String>> {
    let metadata: Value =
        serde_json::from_str(&cargo(&["metadata", "--no-deps", "--format-version", "1"])).unwrap();
    let packages = metadata["packages"].as_array().unwrap();
    let name = |value: &Value| value["name"].as_str().unwrap().to_owned();
    let ours: BTreeSet<String> = packages.iter().map(name).collect();
    let named = |package: &Value| {
        let dependencies = package["dependencies"].as_array().unwrap();
        dependencies.iter().map(name).filter(|dependency| ours.contains(dependency)).collect()
    };
    packages.iter().map(|package| (name(package), named(package))).collect()
}

/// Every crate that is built for a package, without its tests' own.
fn holds(package: &str) -> BTreeSet<String> {
    let tree = cargo(&["tree", "--package", package, "--edges", "no-dev", "--prefix", "none"]);
    tree.lines().filter_map(|line| line.split(' ').next()).map(str::to_owned).collect()
}

fn cargo(arguments: &[&str]) -> String {
    let output = Command::new(env!("CARGO"))
        .args(arguments)
        .arg("--locked")
        .current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn room(package: &str) -> &'static Room {
    ROOMS.iter().find(|room| room.package == package).unwrap_or_else(|| {
        panic!(
            "{package} is a new room: say in this file what it may name and what it must not hold"
        )
    })
}

#[test]
fn arrows_point_only_where_they_may() {
    for (package, named) in arrows() {
        let room = room(&package);
        for other in named {
            assert!(
                room.may_name.contains(&other.as_str()),
                "{package} names {other}, and may name only {:?}",
                room.may_name
            );
        }
    }
}

#[test]
fn rooms_do_not_hold_what_they_must_not_know() {
    for package in arrows().keys() {
        let room = room(package);
        let below_torch = package != MODELS && !room.may_name.contains(&MODELS);
        let held = holds(package);
        assert!(held.contains(package), "the tree of {package} was not read");
        for absent in room.must_not_hold.iter().chain(below_torch.then_some(&TORCH)) {
            assert!(!held.contains(*absent), "{package} must not hold {absent}, however deep");
        }
    }
}
