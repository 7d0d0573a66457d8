//! The program itself: it starts, says where it listens, serves, and ends when it is told to.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

mod checkpoint;

use std::{
    io::{BufRead as _, BufReader, Read as _},
    process::{Command, Stdio},
    thread::sleep,
    time::{Duration, Instant},
};

use checkpoint::checkpoint;
use serde_json::{Value as Json, json};

const PROGRAM: &str = env!("CARGO_BIN_EXE_gatsbi-server");

/// Status and text of an answer, if one comes.
fn get(url: &str) -> reqwest::Result<(u16, String)> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let response = reqwest::get(url).await?;
        Ok((response.status().as_u16(), response.text().await?))
    })
}

#[test]
fn it_is_alive_but_not_ready_while_its_models_load() {
    let folder = tempfile::tempdir().unwrap();
    // Nobody writes, so whoever reads it waits.
    let slow = folder.path().join("slow.safetensors");
    assert!(Command::new("mkfifo").arg(&slow).status().unwrap().success());
    let admin = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let mut server = Command::new(PROGRAM)
        .args(["--grpc-listen", "127.0.0.1:0", "--http-listen", "127.0.0.1:0"])
        .args(["--admin-listen", &admin.to_string(), "--checkpoint"])
        .arg(&slow)
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let until = Instant::now() + Duration::from_secs(30);
    let alive = loop {
        match get(&format!("http://{admin}/healthz")) {
            Ok(answer) => break answer,
            Err(error) => assert!(Instant::now() < until, "{error}"),
        }
        sleep(Duration::from_millis(20));
    };
    let ready = get(&format!("http://{admin}/readyz"));
    server.kill().unwrap();
    server.wait().unwrap();
    assert_eq!(alive.0, 200);
    assert_eq!(ready.unwrap(), (503, "not ready\n".to_owned()));
}

#[test]
fn it_serves_until_it_is_told_to_end() {
    let folder = tempfile::tempdir().unwrap();
    let any = "127.0.0.1:0";
    let mut server = Command::new(PROGRAM)
        // It sets what libgomp needs by itself.
        .env_remove("GOMP_SPINCOUNT")
        .env_remove("OMP_WAIT_POLICY")
        .args(["--grpc-listen", any, "--http-listen", any, "--admin-listen", any])
        .arg("--checkpoint")
        .arg(format!("arm={}", checkpoint(folder.path(), 0).display()))
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(server.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
    let address = |name: &str| {
        let start = line.find(&format!("{name}=")).unwrap() + name.len() + 1;
        line[start..].split_whitespace().next().unwrap().to_owned()
    };
    assert!(line.starts_with("ready "), "{line}");
    let environment = std::fs::read(format!("/proc/{}/environ", server.id())).unwrap();
    let environment = String::from_utf8_lossy(&environment).into_owned();
    assert!(
        environment.contains("GOMP_SPINCOUNT=0") && environment.contains("OMP_WAIT_POLICY=PASSIVE")
    );

    assert_eq!(get(&format!("http://{}/readyz", address("admin"))).unwrap().0, 200);
    let (status, models) = get(&format!("http://{}/v1/models", address("http"))).unwrap();
    assert_eq!(status, 200);
    assert!(models.contains("\"name\":\"arm\""), "{models}");

    let told = Command::new("kill").args(["-TERM", &server.id().to_string()]).status().unwrap();
    assert!(told.success());
    let ended = server.wait().unwrap();
    let mut log = String::new();
    server.stderr.take().unwrap().read_to_string(&mut log).unwrap();
    assert!(ended.success(), "{ended}: {log}");
    assert!(log.contains("shutting down") && !log.contains("ERROR"), "{log}");
}

/// A running program, ended by its id.
struct Program(std::process::Child, String);

impl Program {
    fn start(checkpoint: &std::path::Path) -> Self {
        let any = "127.0.0.1:0";
        let mut child = Command::new(PROGRAM)
            .args(["--grpc-listen", any, "--http-listen", any, "--admin-listen", any])
            .args(["--log", "warn", "--checkpoint"])
            .arg(checkpoint)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
        let start = line.find("http=").unwrap() + 5;
        let http = line[start..].split_whitespace().next().unwrap().to_owned();
        Self(child, http)
    }

    /// Calls the REST API with JSON.
    fn call(&self, method: reqwest::Method, path: &str, body: &Json) -> Json {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let url = format!("http://{}{path}", self.1);
            let request = reqwest::Client::new().request(method, url).json(body);
            let response = request.send().await.unwrap();
            assert!(response.status().is_success(), "{path}: {}", response.status());
            response.json().await.unwrap()
        })
    }

    fn observe(&self, session: &str, step: u64) -> Json {
        let values: Vec<f32> = (0..64 * 64 * 3).map(|i| (i as f32 * 0.37).sin().abs()).collect();
        let pixels = json!({ "dtype": "DATA_TYPE_F32", "shape": [64, 64, 3], "values": values });
        let action = vec![0.1 * step as f32; 7];
        let observation = json!({ "step": step, "image": { "pixels": pixels }, "action": action });
        let outputs = json!({ "outputs": ["OUTPUT_LATENTS", "OUTPUT_OBJECTS", "OUTPUT_FRAME"] });
        let body = json!({ "observation": observation, "outputs": outputs });
        let path = format!("/v1/sessions/{session}/observations");
        let mut answer = self.call(reqwest::Method::POST, &path, &body)["belief"].take();
        assert!(answer["outputs"].as_array().is_some_and(|outputs| outputs.len() == 2));
        for own in ["session_id", "timing"] {
            answer[own].take();
        }
        answer
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

#[test]
fn a_session_moves_from_one_process_to_another() {
    let folder = tempfile::tempdir().unwrap();
    let checkpoint = checkpoint(folder.path(), 0);
    let (here, there) = (Program::start(&checkpoint), Program::start(&checkpoint));
    let opened = here.call(reqwest::Method::POST, "/v1/sessions", &json!({ "seed": 3 }));
    let session = opened["session"]["id"].as_str().unwrap();
    here.observe(session, 0);
    here.observe(session, 1);
    let path = format!("/v1/sessions/{session}/snapshot");
    let snapshot = here.call(reqwest::Method::GET, &path, &json!({}))["snapshot"].take();
    let moved =
        there.call(reqwest::Method::POST, "/v1/snapshots", &json!({ "snapshot": snapshot }));
    let moved = moved["session"]["id"].as_str().unwrap();
    for step in 2..4 {
        assert_eq!(there.observe(moved, step), here.observe(session, step), "step {step}");
    }
}

#[test]
fn it_tells_everything_that_is_wrong_with_its_configuration() {
    let output = Command::new(PROGRAM)
        .args(["--http-listen", "0.0.0.0:0", "--observe-block", "0"])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2));
    let text = String::from_utf8(output.stderr).unwrap();
    for part in ["no --checkpoint", "--allow-public", "--observe-block is 0"] {
        assert!(text.contains(part), "{text}");
    }
}

#[test]
fn a_bad_checkpoint_is_one_sentence_and_its_cause() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("broken.safetensors");
    std::fs::write(&path, b"not a checkpoint").unwrap();
    let any = "127.0.0.1:0";
    let output = Command::new(PROGRAM)
        .args(["--grpc-listen", any, "--http-listen", any, "--admin-listen", any, "--checkpoint"])
        .arg(&path)
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1));
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(
        text.contains("error: a checkpoint cannot be loaded: ")
            && text.contains("broken.safetensors"),
        "{text}"
    );
}
