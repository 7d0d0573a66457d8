//! The programs under test, built by cargo and started as processes.

use std::{
    collections::BTreeMap,
    env, fs,
    io::{BufRead as _, BufReader},
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Output, Stdio},
    sync::OnceLock,
    time::Duration,
};

use gatsbi_client::{Client, NewSession, Options, Session};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

/// Far more than anything here takes: a machine may be busy.
pub(crate) const PATIENCE: Duration = Duration::from_mins(5);

/// A server's process. Dropped, it is killed.
pub(crate) struct Server {
    process: Child,
    pub(crate) grpc: String,
    pub(crate) http: String,
    folder: TempDir,
}

/// What a command printed, and how it ended.
#[derive(Debug)]
pub(crate) struct Answer {
    pub(crate) code: Option<i32>,
    pub(crate) out: String,
    pub(crate) err: String,
}

impl Server {
    /// Starts a server of the untrained model on free ports.
    pub(crate) fn start() -> Self {
        Self::with(&["--grpc-listen", "127.0.0.1:0"])
    }

    /// Starts a server with more flags; `--grpc-listen` has to be one of them.
    pub(crate) fn with(flags: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let log = fs::File::create(folder.path().join("log")).unwrap();
        let any = "127.0.0.1:0";
        let mut process = Command::new(program("gatsbi-server"))
            .args(["--http-listen", any, "--admin-listen", any, "--threads", "1"])
            .args(flags)
            .arg("--checkpoint")
            .arg(format!("tiny={}", checkpoint().display()))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(log)
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(process.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let mut server = Self { process, grpc: String::new(), http: String::new(), folder };
        let address = |name: &str| {
            let address = line.split_whitespace().find_map(|word| word.strip_prefix(name));
            address.unwrap_or_else(|| panic!("{line}{}", server.log())).to_owned()
        };
        (server.grpc, server.http) = (address("grpc="), address("http="));
        server
    }

    /// What it has logged so far.
    pub(crate) fn log(&self) -> String {
        fs::read_to_string(self.folder.path().join("log")).unwrap()
    }

    /// A connection.
    pub(crate) async fn client(&self) -> Client {
        let options = Options { timeout: PATIENCE, ..Options::default() };
        Client::connect_with(&self.grpc, options).await.unwrap()
    }

    /// A new session with a seed.
    pub(crate) async fn session(&self, seed: u64) -> Session {
        let new = NewSession { seed: Some(seed), ..NewSession::default() };
        self.client().await.create_session(new).await.unwrap()
    }

    /// Posts JSON to the REST API; returns status and document.
    pub(crate) async fn post(&self, path: &str, body: &Value) -> (u16, Value) {
        let url = format!("http://{}{path}", self.http);
        let request = reqwest::Client::new().post(url).json(body);
        let response = request.header("accept", "application/json").send().await.unwrap();
        let status = response.status().as_u16();
        (status, response.json().await.unwrap())
    }

    /// Runs the command line against this server.
    pub(crate) fn gatsbi(&self, arguments: &[&str]) -> Answer {
        gatsbi(&[&["--server", &self.grpc, "--timeout", "300"], arguments].concat())
    }

    /// Tells it to end, without waiting.
    pub(crate) fn terminate(&self) {
        kill_process(Pid::from_child(&self.process), Signal::TERM).unwrap();
    }

    /// Waits until it has ended, while connections to it may be closed; returns how, and its log.
    pub(crate) async fn wait(mut self) -> (ExitStatus, String) {
        let wait = move || (self.process.wait().unwrap(), self.log());
        tokio::task::spawn_blocking(wait).await.unwrap()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

impl Answer {
    /// What a command that succeeded printed.
    #[track_caller]
    pub(crate) fn done(self) -> String {
        assert_eq!(self.code, Some(0), "{self:?}");
        self.out
    }

    /// The same, a JSON document a line.
    #[track_caller]
    pub(crate) fn documents(self) -> Vec<Value> {
        self.done().lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    /// The error that a command called with `--json` failed with.
    #[track_caller]
    pub(crate) fn error(&self) -> Value {
        assert_ne!(self.code, Some(0), "{self:?}");
        assert!(self.out.is_empty(), "{self:?}");
        let document: Value = serde_json::from_str(&self.err).unwrap();
        assert_eq!(document["error"]["exit_code"].as_i64(), self.code.map(i64::from));
        document["error"].clone()
    }
}

/// Runs the command line.
pub(crate) fn gatsbi(arguments: &[&str]) -> Answer {
    run("gatsbi", arguments)
}

/// Runs one of our programs to its end.
pub(crate) fn run(name: &str, arguments: &[&str]) -> Answer {
    let mut command = Command::new(program(name));
    for variable in ["GATSBI_SERVER", "GATSBI_API_KEY", "GATSBI_CA"] {
        command.env_remove(variable);
    }
    let Output { status, stdout, stderr } = command.args(arguments).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    Answer { code: status.code(), out: text(stdout), err: text(stderr) }
}

/// The file of one of our programs.
fn program(name: &str) -> &'static Path {
    static PROGRAMS: OnceLock<BTreeMap<String, PathBuf>> = OnceLock::new();
    &PROGRAMS.get_or_init(build)[name]
}

/// Has cargo build the programs, as nothing says that whoever runs a single test has built them anew.
///
/// The selection of packages and targets is one that has `cargo test --workspace` resolve to the same features, so
/// that after it only these programs themselves are left to build.
fn build() -> BTreeMap<String, PathBuf> {
    let target = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().unwrap();
    let mut cargo = Command::new(env!("CARGO"));
    cargo.args(["build", "--workspace", "--test", "end_to_end"]);
    cargo.args(["--bin", "gatsbi", "--bin", "gatsbi-server", "--bin", "gatsbi-train"]);
    cargo.args(["--message-format", "json-render-diagnostics", "--target-dir"]).arg(target);
    if !cfg!(debug_assertions) {
        cargo.arg("--release");
    }
    for (name, _) in env::vars() {
        // This crate's own: a build script that watches them would run again each time.
        if name.starts_with("CARGO_PKG_") || name.starts_with("CARGO_MANIFEST_") {
            cargo.env_remove(name);
        }
    }
    let output = cargo.current_dir(env!("CARGO_MANIFEST_DIR")).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let messages = String::from_utf8(output.stdout).unwrap();
    let messages = messages.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    let program = |message: Value| {
        let file = message["executable"].as_str()?;
        Some((message["target"]["name"].as_str()?.to_owned(), PathBuf::from(file)))
    };
    messages.filter_map(program).collect()
}

/// A checkpoint of the tiny preset with untrained weights.
fn checkpoint() -> &'static Path {
    static FILE: OnceLock<PathBuf> = OnceLock::new();
    FILE.get_or_init(|| {
        let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("end-to-end.safetensors");
        let mut init = Command::new(program("gatsbi-train"));
        init.args(["init", "--preset", "tiny", "--seed", "5", "--out"]).arg(&path);
        let Output { status, stderr, .. } = init.output().unwrap();
        assert!(status.success(), "{}", String::from_utf8_lossy(&stderr));
        path
    })
}
