//! The downloader of `cargo xtask setup` against a local package index: what it resumes, what it refuses, and
//! that each failure is one sentence. It needs `python3` with pip, as the set-up itself does.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use fs_err as fs;
use serde_json::{Value, json};
use tempfile::TempDir;

/// A running index, its wheel's facts, and the folders that a set-up would use.
struct Index {
    server: Child,
    facts: Value,
    folder: TempDir,
}

/// What one run of the downloader printed.
struct Run {
    succeeded: bool,
    sentence: String,
    progress: String,
}

impl Index {
    fn serve(manners: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let (server, facts) = start(folder.path(), manners);
        Self { server, facts, folder }
    }

    /// Serves the same folder with other manners.
    fn serve_again(&mut self, manners: &[&str]) {
        stop(&mut self.server);
        (self.server, self.facts) = start(self.folder.path(), manners);
    }

    fn recipe(&self) -> Value {
        json!({ "disk_bytes": 1_000_000, "wheels": [{
            "file": self.facts["file"], "bytes": self.facts["bytes"], "sha256": self.facts["sha256"],
            "members": { "sample/lib/one.so": "torch/lib/one.so", "sample/include/": "torch/include/" },
        }]})
    }

    fn fetch(&self, recipe: &Value) -> Run {
        let url = self.facts["url"].as_str().unwrap();
        fetch("python3", url, recipe, &self.path("downloads"), &self.path("target"))
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn part(&self) -> PathBuf {
        self.path(&format!("downloads/{}.part", self.facts["file"].as_str().unwrap()))
    }

    fn wheel(&self) -> Vec<u8> {
        fs::read(self.path(self.facts["file"].as_str().unwrap())).unwrap()
    }

    fn leave_part(&self, bytes: &[u8]) {
        fs::create_dir_all(self.path("downloads")).unwrap();
        fs::write(self.part(), bytes).unwrap();
    }

    /// The `Range` headers of the requests for the wheel so far.
    fn requests(&self) -> Vec<String> {
        let log = fs::read_to_string(self.path("requests")).unwrap_or_default();
        log.lines().map(str::to_owned).collect()
    }

    #[track_caller]
    fn check_unpacked(&self, run: &Run) {
        assert!(run.succeeded, "{}{}", run.sentence, run.progress);
        assert_eq!(run.sentence, "");
        assert_eq!(fs::read(self.path("target/torch/lib/one.so")).unwrap().len(), 300_000);
        assert!(self.path("target/torch/include/two.h").exists());
        let beside: Vec<_> = fs::read_dir(self.path("target")).unwrap().collect();
        assert_eq!(beside.len(), 1, "only what the recipe names: {beside:?}");
        assert_eq!(fs::read_dir(self.path("downloads")).unwrap().count(), 0);
    }
}

impl Drop for Index {
    fn drop(&mut self) {
        stop(&mut self.server);
    }
}

fn start(folder: &Path, manners: &[&str]) -> (Child, Value) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/package_index.py");
    let mut server = Command::new("python3")
        .arg(script)
        .arg(folder)
        .args(manners)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(server.stdout.take().unwrap()).read_line(&mut line).unwrap();
    (server, serde_json::from_str(&line).unwrap())
}

fn stop(server: &mut Child) {
    server.kill().unwrap();
    server.wait().unwrap();
}

fn fetch(python: &str, url: &str, recipe: &Value, downloads: &Path, target: &Path) -> Run {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("libtorch/fetch.py");
    let output = Command::new(python)
        .arg("-")
        .arg(recipe.to_string())
        .args([downloads, target])
        .stdin(fs::File::open(script).unwrap().into_parts().0)
        .env("PIP_CONFIG_FILE", "/dev/null")
        .env("PIP_INDEX_URL", url)
        .env("NO_PROXY", "127.0.0.1")
        .env_remove("PIP_EXTRA_INDEX_URL")
        .env_remove("PIP_FIND_LINKS")
        .output()
        .unwrap();
    Run {
        succeeded: output.status.success(),
        sentence: String::from_utf8(output.stdout).unwrap(),
        progress: String::from_utf8(output.stderr).unwrap(),
    }
}

#[track_caller]
fn check_failure(run: &Run, expected: &[&str]) {
    assert!(!run.succeeded, "{}", run.progress);
    assert_eq!(run.sentence.lines().count(), 1, "one sentence: {}{}", run.sentence, run.progress);
    for words in expected {
        assert!(run.sentence.contains(words), "`{words}` is not in: {}", run.sentence);
    }
    assert!(!run.progress.contains("Traceback"), "{}", run.progress);
}

#[test]
fn a_wheel_is_found_downloaded_and_unpacked() {
    let index = Index::serve(&[]);
    index.check_unpacked(&index.fetch(&index.recipe()));
    assert_eq!(index.requests(), ["bytes=0-"]);
}

#[test]
fn an_earlier_download_is_continued() {
    let index = Index::serve(&[]);
    index.leave_part(&index.wheel()[..123_456]);
    index.check_unpacked(&index.fetch(&index.recipe()));
    assert_eq!(index.requests(), ["bytes=123456-"]);
}

#[test]
fn a_complete_download_is_not_asked_for_again() {
    let index = Index::serve(&[]);
    index.leave_part(&index.wheel());
    index.check_unpacked(&index.fetch(&index.recipe()));
    assert_eq!(index.requests(), [""; 0]);
}

#[test]
fn an_unpacked_wheel_is_not_fetched_again() {
    let index = Index::serve(&[]);
    fs::create_dir_all(index.path("target")).unwrap();
    let mark = format!("target/{}.unpacked", index.facts["file"].as_str().unwrap());
    fs::write(index.path(&mark), "").unwrap();
    assert!(index.fetch(&index.recipe()).succeeded);
    assert_eq!(index.requests(), [""; 0]);
    assert!(!index.path(&mark).exists());
}

#[test]
fn a_damaged_part_is_noticed_and_replaced() {
    let index = Index::serve(&[]);
    index.leave_part(&[0; 1000]);
    let run = index.fetch(&index.recipe());
    index.check_unpacked(&run);
    assert!(run.progress.contains("damaged: starting over"), "{}", run.progress);
    assert_eq!(index.requests(), ["bytes=1000-", "bytes=0-"]);
}

#[test]
fn a_part_longer_than_the_wheel_is_replaced() {
    let index = Index::serve(&[]);
    index.leave_part(&vec![0; 400_000]);
    index.check_unpacked(&index.fetch(&index.recipe()));
}

#[test]
fn a_server_without_ranges_sends_the_whole_again() {
    let index = Index::serve(&["--no-range"]);
    index.leave_part(&index.wheel()[..1000]);
    index.check_unpacked(&index.fetch(&index.recipe()));
    assert_eq!(index.requests(), ["bytes=1000-"]);
}

#[test]
fn a_connection_that_breaks_is_made_again() {
    let index = Index::serve(&["--slice", "131072"]);
    index.check_unpacked(&index.fetch(&index.recipe()));
    assert_eq!(index.requests(), ["bytes=0-", "bytes=131072-", "bytes=262144-"]);
}

#[test]
fn a_transfer_that_stays_broken_is_kept_for_the_next_run() {
    let mut index = Index::serve(&["--until", "200000"]);
    check_failure(
        &index.fetch(&index.recipe()),
        &["the download of gatsbi_sample-1.0", "broke off at", "it continues there"],
    );
    assert_eq!(fs::read(index.part()).unwrap(), index.wheel()[..200_000]);
    index.serve_again(&[]);
    index.check_unpacked(&index.fetch(&index.recipe()));
    assert_eq!(index.requests().last().unwrap(), "bytes=200000-");
}

#[test]
fn what_the_index_serves_to_pip_alone_is_left_to_pip() {
    let index = Index::serve(&["--refuse-direct"]);
    let run = index.fetch(&index.recipe());
    index.check_unpacked(&run);
    assert!(run.progress.contains("403"), "{}", run.progress);
    assert_eq!(index.requests(), ["bytes=0-", "None"]);
}

#[test]
fn another_file_under_the_same_name_is_refused() {
    let index = Index::serve(&[]);
    let mut recipe = index.recipe();
    recipe["wheels"][0]["sha256"] = "0".repeat(64).into();
    check_failure(&index.fetch(&recipe), &["does not have the expected checksum"]);
    assert!(!index.part().exists());
    assert!(!index.path("target/torch").exists());
}

#[test]
fn a_wheel_that_the_index_does_not_offer_is_named() {
    let index = Index::serve(&[]);
    let mut recipe = index.recipe();
    recipe["wheels"][0]["file"] = "gatsbi_sample-2.0-py3-none-any.whl".into();
    check_failure(&index.fetch(&recipe), &["does not offer gatsbi_sample-2.0-py3-none-any.whl"]);
}

#[test]
fn an_index_out_of_reach_is_named() {
    let mut index = Index::serve(&[]);
    stop(&mut index.server);
    let url = index.facts["url"].as_str().unwrap();
    check_failure(&index.fetch(&index.recipe()), &["pip cannot reach", url, "Connection refused"]);
}

#[test]
fn too_small_a_disk_is_noticed_before_the_download() {
    let index = Index::serve(&[]);
    let mut recipe = index.recipe();
    recipe["disk_bytes"] = 4_000_000_000_000_000_u64.into();
    check_failure(&index.fetch(&recipe), &["GB free and 4000000.0 GB are needed", "GATSBI_CACHE"]);
    assert_eq!(index.requests(), [""; 0]);
}

#[test]
fn a_python_without_pip_is_named() {
    let index = Index::serve(&[]);
    let venv = index.path("venv");
    let made = Command::new("python3").args(["-m", "venv", "--without-pip"]).arg(&venv).status();
    assert!(made.unwrap().success());
    let python = venv.join("bin/python3");
    let (downloads, target) = (index.path("downloads"), index.path("target"));
    let run = fetch(python.to_str().unwrap(), "", &index.recipe(), &downloads, &target);
    check_failure(&run, &["has no pip: install it", python.to_str().unwrap()]);
}
