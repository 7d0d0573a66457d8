//! The command `gatsbi` as people and scripts use it.

use std::path::Path;

use serde_json::Value;

use crate::{
    programs::{Server, gatsbi},
    recording::file,
};

#[test]
fn people_read_tables_and_scripts_read_json() {
    let server = Server::start();
    let folder = tempfile::tempdir().unwrap();
    let file = file();
    let file = file.to_str().unwrap();

    let table = server.gatsbi(&["models"]).done();
    assert!(table.contains("tiny") && table.contains("64x64"), "{table}");
    let models = server.gatsbi(&["models", "--json"]).documents();
    assert_eq!(models[0]["models"][0]["name"], "tiny");
    let card = server.gatsbi(&["model", "tiny"]).done();
    assert!(card.contains("agent slot    0") && card.contains("untrained"), "{card}");

    let id = server.gatsbi(&["session", "new", "--id", "--seed", "7", "--label", "arm"]).done();
    let id = id.trim_end();
    let pictures = folder.path().join("pictures");
    let observe = ["observe", "--session", id, "--episode", file];
    let seen = server
        .gatsbi(&[&observe[..], &["--frames", "..3", "--png", text(&pictures)]].concat())
        .done();
    let steps = seen.lines().skip(2).filter_map(|line| line.split_whitespace().next());
    assert_eq!(steps.take(3).collect::<Vec<_>>(), ["0", "1", "2"], "{seen}");
    for step in 0..3 {
        let picture = pictures.join(format!("step-{step:04}.png"));
        assert!(image::open(&picture).unwrap().width() > 64);
    }
    let next =
        server.gatsbi(&["observe", "--session", id, "--dropped", "--json", "--action", NONE]);
    let next = next.documents();
    assert_eq!((&next[0]["step"], &next[0]["predicted"]), (&3.into(), &true.into()));

    let imagine = ["imagine", "--session", id, "--random", "3", "--horizon", "4"];
    let futures = server.gatsbi(&[&imagine[..], &["--samples", "2"]].concat()).done();
    assert!(futures.starts_with("from step 3: 3 candidates x 2 samples x 4 steps"), "{futures}");
    let every = ["--samples", "2", "--every", "2", "--json"];
    let futures = server.gatsbi(&[&imagine[..], &every].concat()).documents();
    let numbers = |future: &Value| {
        ["candidate", "sample", "depth"].map(|name| future[name].as_u64().unwrap())
    };
    let expected: Vec<_> =
        (0..3).flat_map(|c| (0..2).flat_map(move |s| [[c, s, 2], [c, s, 4]])).collect();
    assert_eq!(futures.iter().map(numbers).collect::<Vec<_>>(), expected);

    let listed = server.gatsbi(&["session", "list", "--label", "arm", "--json"]).documents();
    assert_eq!(listed[0]["sessions"][0]["next_step"], 4);
    let shown = server.gatsbi(&["session", "show", id]).done();
    assert!(shown.contains("drawn with seed 7"), "{shown}");
    server.gatsbi(&["session", "delete", id]).done();
    let listed = server.gatsbi(&["session", "list", "--json"]).documents();
    assert_eq!(listed[0]["sessions"], Value::Array(Vec::new()));
}

#[test]
fn the_demo_measures_and_paints() {
    let server = Server::start();
    let folder = tempfile::tempdir().unwrap();
    let (file, folder) = (file(), folder.path().join("demo"));
    let demo = ["demo", "--episodes", text(&file), "--out", text(&folder), "--observe", "33"];
    let told = server.gatsbi(&[&demo[..], &["--json"]].concat()).documents();
    let told = &told[0];
    assert_eq!((&told["observed"], &told["found"]["labelled_objects"]), (&33.into(), &4.into()));
    let steps = told["imagined"]["steps"].as_array().unwrap();
    assert_eq!(steps.len(), 7);
    assert!(steps.iter().all(|step| step["imagined_mse"].as_f64().unwrap() > 0.0));
    let futures = told["imagined"]["futures"].as_array().unwrap();
    assert_eq!(futures.len(), 4, "three candidates and the copy");
    let pictures = told["pictures"].as_array().unwrap();
    assert_eq!(pictures.len(), 4);
    for picture in pictures {
        let picture = image::open(picture.as_str().unwrap()).unwrap();
        assert!(picture.width() >= 576 && picture.height() >= 400);
    }
    let told = server.gatsbi(&demo).done();
    for line in ["model ", "agent     slot 0, ", "the recorded actions ", "mean ", "pictures, "] {
        assert!(told.lines().any(|told| told.trim_start().starts_with(line)), "{line}: {told}");
    }
    let sessions = server.gatsbi(&["session", "list", "--json"]).documents();
    assert_eq!(sessions[0]["sessions"], Value::Array(Vec::new()), "the demo leaves none behind");
}

#[tokio::test]
async fn exit_codes_say_whose_turn_it_is() {
    let server = Server::start();
    let id = server.gatsbi(&["session", "new", "--id"]).done();
    let id = id.trim_end();
    let file = file();
    let wrong = |arguments: &[&str], code: i32, says: &str| {
        let error = server.gatsbi(&[arguments, &["--json"]].concat()).error();
        assert_eq!(error["exit_code"], code, "{error}");
        assert!(error["message"].as_str().unwrap().contains(says), "{error}");
    };
    wrong(&["observe", "--session", id, "--image", "none.png"], 2, "none.png");
    let episode = ["observe", "--session", id, "--episode", text(&file)];
    wrong(&[&episode[..], &["--index", "6"]].concat(), 2, "--index is 6, expected 0 to 5");
    wrong(&[&episode[..], &["--frames", "39..41"]].concat(), 2, "--frames is 39..41");
    let imagine = ["imagine", "--session", id, "--random", "2"];
    wrong(&[&imagine[..], &["--horizon", "257"]].concat(), 2, "expected 1 to 256");
    wrong(&[&imagine[..], &["--horizon", "2"]].concat(), 3, "observed");
    wrong(&["model", "none"], 3, "none");
    let address = server.grpc.clone();
    server.terminate();
    server.wait().await;
    let answer = gatsbi(&["models", "--server", &address]);
    assert_eq!(answer.code, Some(4), "{answer:?}");
    assert!(answer.err.contains(&address) && answer.err.contains("--server"), "{answer:?}");
}

/// An action that does nothing.
const NONE: &str = "0,0,0,0,0,0,0";

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}
