//! The program as its operator knows it: what it says when it is told wrong, and what it does on SIGHUP and SIGTERM.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

mod checkpoint;

use std::{
    io::{BufRead as _, BufReader},
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use checkpoint::checkpoint;

const PROGRAM: &str = env!("CARGO_BIN_EXE_gatsbi-server");
const ANY: &str = "127.0.0.1:0";

/// A program that runs without what the environment of the test says.
fn program() -> Command {
    let mut command = Command::new(PROGRAM);
    for (name, _) in std::env::vars_os() {
        if name.to_string_lossy().starts_with("GATSBI_") {
            command.env_remove(name);
        }
    }
    command
}

/// The exit code and what was said on standard error, a line each.
fn told(command: &mut Command) -> (Option<i32>, Vec<String>) {
    let output = command.output().unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    let errors = text.lines().filter(|line| line.starts_with("error: ")).map(str::to_owned);
    (output.status.code(), errors.collect())
}

fn write(folder: &Path, name: &str, text: &str, mode: u32) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, text).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
    path
}

/// A certificate that is valid from and to these years.
fn certificate(folder: &Path, name: &str, years: (i32, i32)) -> (PathBuf, PathBuf) {
    let key = rcgen::KeyPair::generate().unwrap();
    let mut params = rcgen::CertificateParams::new(vec!["localhost".to_owned()]).unwrap();
    params.not_before = rcgen::date_time_ymd(years.0, 1, 1);
    params.not_after = rcgen::date_time_ymd(years.1, 1, 1);
    let certificate = params.self_signed(&key).unwrap();
    (
        write(folder, &format!("{name}.pem"), &certificate.pem(), 0o644),
        write(folder, &format!("{name}.key"), &key.serialize_pem(), 0o600),
    )
}

#[test]
fn each_mistake_is_one_sentence_and_no_success() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let taken = std::net::TcpListener::bind(ANY).unwrap();
    let taken = taken.local_addr().unwrap();
    let open_keys = write(folder, "open.toml", "", 0o644);
    let empty_keys = write(folder, "empty.toml", "", 0o600);
    let (old, old_key) = certificate(folder, "old", (2020, 2021));
    let (coming, coming_key) = certificate(folder, "coming", (2090, 2091));
    let (good, good_key) = certificate(folder, "good", (2020, 2090));
    let shown = |path: &Path| path.display().to_string();
    let run = |flags: &[&str]| {
        let mut command = program();
        command.args(["--grpc-listen", ANY, "--http-listen", ANY, "--admin-listen", ANY]);
        command.args(["--checkpoint", "nowhere.safetensors"]).args(flags);
        told(&mut command)
    };
    let tls = |certificate: &Path, key: &Path| {
        run(&["--tls-certificate", &shown(certificate), "--tls-key", &shown(key)])
    };
    let taken = taken.to_string();
    let busy = {
        let mut command = program();
        command.args(["--grpc-listen", ANY, "--http-listen", ANY, "--admin-listen", &taken]);
        told(command.args(["--checkpoint", "nowhere.safetensors"]))
    };
    let cases = [
        (
            run(&["--config", "/nowhere.toml"]),
            2,
            "error: the configuration /nowhere.toml cannot be read: No such file",
        ),
        (
            run(&["--tls-key", "x"]),
            2,
            "error: --tls-certificate and --tls-key must be given together",
        ),
        (
            run(&["--tenant-max-rows", "4"]),
            2,
            "error: --tenant-max-rows needs --keys: without keys there are no tenants",
        ),
        (run(&["--log", "gatsbi=loud"]), 2, "error: --log is \"gatsbi=loud\": "),
        (
            run(&["--otlp-endpoint", "http://x"]),
            2,
            "error: --otlp-endpoint needs a server that was built with the feature otel",
        ),
        (busy, 1, &format!("error: {taken} cannot be listened on: Address already in use")),
        (
            run(&["--keys", "/nowhere"]),
            1,
            "error: the file of keys /nowhere cannot be read: No such file",
        ),
        (run(&["--keys", &shown(&open_keys)]), 1, "has permissions 0644, expected 0600: chmod 600"),
        (
            run(&["--keys", &shown(&empty_keys)]),
            1,
            "cannot be used: it has no keys; `gatsbi-server keys new` makes one",
        ),
        (tls(&old, &old_key), 1, "old.pem expired on 2021-01-01T00:00:00Z"),
        (tls(&coming, &coming_key), 1, "coming.pem is valid from 2090-01-01T00:00:00Z only"),
        (tls(&good, &old_key), 1, "cannot be used: keys may not be consistent: KeyMismatch"),
        (tls(&good, &good), 1, "error: the private key"),
        (run(&[]), 1, "error: a checkpoint cannot be loaded: "),
    ];
    assert!(shown(&good_key).ends_with("good.key"));
    for ((code, errors), expected, part) in cases {
        assert_eq!((code, errors.len()), (Some(expected), 1), "{part}: {errors:?}");
        assert!(errors[0].contains(part), "{part}: {errors:?}");
    }
}

#[test]
fn everything_that_is_wrong_is_told_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let text =
        "[limits]\nmax_rows = \"many\"\nmax_row = 3\n[listeners]\nhttp_listen = \"0.0.0.0:80\"\n";
    let file = write(folder.path(), "gatsbi.toml", text, 0o644);
    let mut command = program();
    command.arg("--config").arg(&file).args(["--observe-block", "0"]);
    let (code, errors) = told(command.env("GATSBI_THREADS", "two"));
    let errors = errors.join("\n");
    assert_eq!(code, Some(2));
    for part in [
        "gatsbi.toml: [limits] max_row is not a setting",
        "gatsbi.toml: [limits] max_rows: invalid value 'many'",
        "GATSBI_THREADS: invalid value 'two'",
        "--observe-block is 0, expected 1 to 1024",
        "--http-listen 0.0.0.0:80 can be reached from other machines",
        "no --checkpoint or --checkpoint-folder is given",
    ] {
        assert!(errors.contains(part), "{part}\n{errors}");
    }
    assert_eq!(errors.lines().count(), 6, "{errors}");
}

#[test]
fn settings_are_printed_as_a_file_that_gives_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let text = "[limits]\nmax_rows = 5000\n[engine]\nthreads = 3\n";
    let file = write(folder.path(), "gatsbi.toml", text, 0o644);
    let print = |file: &Path| {
        let mut command = program();
        command.arg("--config").arg(file).args(["--checkpoint", "a", "--print-config"]);
        let output = command.env("GATSBI_THREADS", "4").env("GATSBI_LOG", "warn").output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    let printed = print(&file);
    for line in ["threads = 4", "max_rows = 5000", "log = \"warn\"", "checkpoint = [\"a\"]"] {
        assert!(printed.lines().any(|it| it == line), "{line}\n{printed}");
    }
    assert_eq!(print(&write(folder.path(), "again.toml", &printed, 0o644)), printed);
}

/// A running server, ended by its id.
struct Running {
    child: Child,
    http: String,
    admin: String,
    log: PathBuf,
}

impl Running {
    fn start(folder: &Path, flags: &[&str]) -> Self {
        let log = folder.join("log");
        let mut child = program()
            .args(["--grpc-listen", ANY, "--http-listen", ANY, "--admin-listen", ANY])
            .args(flags)
            .stdout(Stdio::piped())
            .stderr(std::fs::File::create(&log).unwrap())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
        let address = |name: &str| {
            let log = || std::fs::read_to_string(&log).unwrap();
            let at = line.find(name).unwrap_or_else(|| panic!("{line}{}", log())) + name.len();
            line[at..].split_whitespace().next().unwrap().to_owned()
        };
        let (http, admin) = (address("http="), address("admin="));
        Self { child, http, admin, log }
    }

    fn signal(&self, signal: &str) {
        let id = self.child.id().to_string();
        assert!(Command::new("kill").args([signal, &id]).status().unwrap().success());
    }

    fn log(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap()
    }

    /// Waits until the log says something so many times.
    fn says(&self, part: &str, times: usize) {
        let patience = Instant::now() + Duration::from_mins(2);
        while self.log().matches(part).count() < times {
            assert!(Instant::now() < patience, "{part} is not in {}", self.log());
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    fn get(&self, path: &str, key: Option<&str>) -> (u16, String) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let client = reqwest::Client::new();
            let request = client.get(format!("http://{}{path}", self.http));
            let request = match key {
                Some(key) => request.bearer_auth(key),
                None => request,
            };
            let answer = request.send().await.unwrap();
            (answer.status().as_u16(), answer.text().await.unwrap())
        })
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.child.kill().ok();
        self.child.wait().ok();
    }
}

fn new_key(file: &Path) -> String {
    let mut command = program();
    command.args(["keys", "new", "--tenant", "lab", "--role", "read", "--file"]).arg(file);
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap().trim().to_owned()
}

#[test]
fn sighup_has_keys_settings_and_checkpoints_read_again() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let keys = folder.join("keys.toml");
    let first = new_key(&keys);
    let mode = std::fs::metadata(&keys).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o600);
    let path = checkpoint(folder, 1);
    let text = |log: &str, more: &str| {
        let keys = keys.display();
        // Another name for the model is a change that needs a restart.
        let name = if more.is_empty() { "" } else { "renamed=" };
        let path = format!("{name}{}", path.display());
        format!(
            "[models]\ncheckpoint = [\"{path}\"]\n[access]\nkeys = \"{keys}\"\n\
             [operation]\nlog = \"{log}\"\nlog_format = \"json\"\n{more}"
        )
    };
    let file = write(folder, "gatsbi.toml", &text("info", ""), 0o644);
    let server = Running::start(folder, &["--config", file.to_str().unwrap()]);
    let (status, before) = server.get("/v1/models", Some(&first));
    assert_eq!(status, 200, "{before}");
    assert_eq!(server.get("/v1/models", None).0, 401);

    let second = new_key(&keys);
    assert_eq!(server.get("/v1/models", Some(&second)).0, 401, "not yet");
    checkpoint(folder, 2);
    write(folder, "gatsbi.toml", &text("debug", "[engine]\nthreads = 3\n"), 0o644);
    server.signal("-HUP");
    server.says("checkpoint loaded anew", 1);
    assert_eq!(server.get("/v1/models", Some(&second)).0, 200);
    let hash = |models: &str| {
        let models: serde_json::Value = serde_json::from_str(models).unwrap();
        models["models"][0]["hash"].as_str().unwrap().to_owned()
    };
    assert_ne!(hash(&server.get("/v1/models", Some(&first)).1), hash(&before));
    let log = server.log();
    assert!(log.contains("\"setting\":\"threads\"") && log.contains("takes effect when"), "{log}");
    assert!(log.contains("\"level\":\"DEBUG\""), "{log}");
    for line in log.lines() {
        let line: serde_json::Value = serde_json::from_str(line).unwrap();
        assert!(line["timestamp"].is_string(), "{line}");
    }

    // What needs a restart is told again, and waits for one however often it is told.
    checkpoint(folder, 3);
    server.signal("-HUP");
    server.says("checkpoint loaded anew", 2);
    for setting in ["threads", "checkpoint"] {
        server.says(&format!("\"setting\":\"{setting}\""), 2);
    }
    write(folder, "gatsbi.toml", "[limits]\nmax_rows = 0\n", 0o644);
    server.signal("-HUP");
    server.says("the configuration stays as it was", 2);
    let models = server.get("/v1/models", Some(&first)).1;
    assert!(models.contains("\"name\":\"tiny\"") && !models.contains("renamed"), "{models}");
    write(folder, "gatsbi.toml", &text("debug", ""), 0o644);
    write(folder, "keys.toml", "nonsense", 0o600);
    server.signal("-HUP");
    server.says("the keys stay as they were", 1);
    assert_eq!(server.get("/v1/models", Some(&second)).0, 200, "as before");
    let log = server.log();
    assert!(![&first, &second].iter().any(|key| log.contains(key.as_str())), "no secret is logged");
}

#[test]
fn requests_that_do_not_end_keep_the_server_no_longer_than_said() {
    use std::io::Write as _;

    let folder = tempfile::tempdir().unwrap();
    let path = checkpoint(folder.path(), 1);
    let flags = ["--checkpoint", path.to_str().unwrap(), "--drain-seconds", "6"];
    let mut server = Running::start(folder.path(), &flags);
    // A request whose body never comes.
    let mut stream = std::net::TcpStream::connect(&server.http).unwrap();
    let head = "POST /v1/sessions HTTP/1.1\r\nhost: x\r\ncontent-length: 10\r\n\r\n";
    stream.write_all(head.as_bytes()).unwrap();
    assert_eq!(server.get("/v1/models", None).0, 200, "it has come in behind that one");
    assert!(!server.admin.is_empty());
    let told = Instant::now();
    server.signal("-TERM");
    let ended = server.child.wait().unwrap();
    assert!(ended.success(), "{ended}: {}", server.log());
    let took = told.elapsed();
    assert!(took >= Duration::from_secs(6) && took < Duration::from_secs(12), "{took:?}");
    assert!(server.log().contains("requests were cut off"), "{}", server.log());
}
