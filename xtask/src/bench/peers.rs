//! Other servers with the model's twin behind them, beside ours: sixteen robots that observe at once.
//!
//! All have the same weights, both cores, and the same generator of load, which speaks to each in its leanest way; they
//! take turns. What is behind the others is in `tests/load/peers`.

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use fs_err as fs;
use rustix::process::{Pid, Signal, kill_process_group};

use super::side::Side;
use super::{Arguments, Tools, median, progress};
use crate::process::Running;
use crate::server::Server;

const FOLDER: &str = ".venv-peers";
const SOURCES: &str = "tests/load/peers";
const CHECKPOINT: &str = "models/checkpoints/push1-tiny.safetensors";
const PEERS: [&str; 3] = ["triton", "mosec", "litserve"];
const OURS: &str = "gatsbi";

/// For a peer to load PyTorch and the model.
const PATIENCE: Duration = Duration::from_mins(3);

/// For a peer to end in.
const GRACE: Duration = Duration::from_secs(10);

/// A server under load.
struct Peer {
    load: Side,
    process: Option<Running>,
}

/// Where everything of the peers is.
struct Place {
    venv: PathBuf,
    sources: PathBuf,
    packages: PathBuf,
    python_path: String,
    checkpoint: PathBuf,
    backends: PathBuf,
    log: PathBuf,
}

/// Figures by name.
pub(super) fn measure(tools: &Tools<'_>, arguments: &Arguments) -> Result<BTreeMap<String, f64>> {
    let place = Place::new(tools)?;
    let seconds = if arguments.quick { 2.0 } else { 8.0 };
    let mut server = Command::new(tools.programs.named("gatsbi-server")?);
    server
        .args(["--workers", "2", "--threads", "1", "--observe-block", "8", "--checkpoint"])
        .arg(&place.checkpoint);
    let log = tools.folder.path().join("server.log");
    let server = Server::start(&mut server, &log, &tools.interrupt)?;
    let mut ours = tools.load(None, &server.grpc)?;
    let mut peers = BTreeMap::new();
    for name in PEERS {
        progress(&format!("starting {name}"));
        peers.insert(name, place.start(name, tools)?);
    }
    let mut found: BTreeMap<(&str, &str), Vec<f64>> = BTreeMap::new();
    for round in 0..=arguments.rounds {
        for (robots, figure) in [("16", "observe16_rps"), ("1", "observe1_rps")] {
            let time = if round == 0 { 0.5 } else { seconds };
            let request = format!("observe {robots} {time}");
            let peers = peers.iter_mut().map(|(name, peer)| (*name, &mut peer.load));
            for (name, load) in peers.chain([(OURS, &mut ours)]) {
                tools.interrupt.check()?;
                progress(&format!(
                    "round {round} of {}: {name}, {robots} robots",
                    arguments.rounds
                ));
                let rate = load.ask(&request)?[0];
                // The first round is to be warm.
                found.entry((name, figure)).or_default().extend((round > 0).then_some(rate));
            }
        }
    }
    progress("");
    server.process.stop()?;
    Ok(figures(&found))
}

/// Rates, and ours over the best peer's as the median over the rounds.
fn figures(found: &BTreeMap<(&str, &str), Vec<f64>>) -> BTreeMap<String, f64> {
    let rates = found
        .iter()
        .map(|((name, figure), rates)| (format!("{name}.{figure}"), median(rates.clone())));
    let mut figures: BTreeMap<String, f64> = rates.collect();
    for (figure, key) in
        [("observe16_rps", "observe16_vs_best_peer"), ("observe1_rps", "observe1_vs_best_peer")]
    {
        let ours = &found[&(OURS, figure)];
        let ratio = PEERS.map(|peer| {
            let theirs = &found[&(peer, figure)];
            median(ours.iter().zip(theirs).map(|(ours, theirs)| ours / theirs).collect())
        });
        figures.insert(key.to_owned(), ratio.into_iter().fold(f64::INFINITY, f64::min));
    }
    figures
}

impl Place {
    fn new(tools: &Tools<'_>) -> Result<Self> {
        let (root, venv) = (tools.root, tools.root.join(FOLDER));
        let sources = root.join(SOURCES);
        if !venv.join("bin/mosec").exists() {
            make(&venv, &sources)?;
        }
        let text = |command: &mut Command| -> Result<String> {
            let output = command.output()?;
            ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
            Ok(String::from_utf8(output.stdout)?.trim().to_owned())
        };
        let site = ["-c", "import sysconfig; print(sysconfig.get_path('purelib'))"];
        let packages = PathBuf::from(text(Command::new(venv.join("bin/python")).args(site))?);
        let torch = text(Command::new(&tools.python).args(site))?;
        let twin = root.join("tests/reference");
        // Its own packages first: Triton's client and torch want other versions of numpy.
        let path =
            [&sources, &twin, &packages, Path::new(&torch)].map(|part| part.display().to_string());
        Ok(Self {
            checkpoint: root.join(CHECKPOINT),
            backends: tools.folder.path().join("backends"),
            log: tools.folder.path().join("peers.log"),
            python_path: path.join(":"),
            venv,
            sources,
            packages,
        })
    }

    /// Starts a server, and the load of it, when it answers.
    fn start(&self, name: &'static str, tools: &Tools<'_>) -> Result<Peer> {
        let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
        let mut command = match name {
            "triton" => self.triton(port)?,
            "mosec" => {
                let mut command = Command::new(self.venv.join("bin/python"));
                command
                    .arg(self.sources.join("mosec_server.py"))
                    .arg("--port")
                    .arg(port.to_string());
                command.args(["--address", "127.0.0.1", "--timeout", "60000"]);
                command
            }
            _ => {
                let mut command = Command::new(self.venv.join("bin/python"));
                command.arg(self.sources.join("litserve_server.py")).arg(port.to_string());
                command
            }
        };
        let log = fs::OpenOptions::new().create(true).append(true).open(&self.log)?.into_file();
        command
            .env("PYTHONPATH", &self.python_path)
            .env("GATSBI_CHECKPOINT", &self.checkpoint)
            .env("GATSBI_THREADS", "2")
            // Threads that spin while others have the core slow everybody down.
            .envs([("OMP_WAIT_POLICY", "PASSIVE"), ("GOMP_SPINCOUNT", "0")])
            .stdin(Stdio::null())
            .stdout(log.try_clone()?)
            .stderr(log)
            .process_group(0);
        let mut process = Running::start(&mut command, GRACE)?;
        let url = format!("http://127.0.0.1:{port}");
        let began = Instant::now();
        loop {
            tools.interrupt.check()?;
            let mut load = tools.load(Some(name), &url)?;
            match load.ask("observe 1 0") {
                Ok(_) => return Ok(Peer { load, process: Some(process) }),
                Err(error) if began.elapsed() > PATIENCE || process.child.try_wait()?.is_some() => {
                    let log = fs::read_to_string(&self.log)?;
                    bail!("{name} does not answer ({error:#}):\n{log}");
                }
                Err(_not_yet) => sleep(Duration::from_secs(1)),
            }
        }
    }

    /// Triton's server as PyTriton's package brings it, with its own Python backend.
    fn triton(&self, port: u16) -> Result<Command> {
        let server = self.packages.join("pytriton/tritonserver");
        let backend = self.backends.join("python");
        fs::create_dir_all(&backend)?;
        let version = self.packages.parent().and_then(Path::file_name).context("no version")?;
        let version = version.to_string_lossy().replace("python", "");
        let stub = "triton_python_backend_stub";
        for file in ["libtriton_python.so", "triton_python_backend_utils.py"] {
            fs::copy(server.join("backends/python").join(file), backend.join(file))?;
        }
        fs::copy(server.join("python_backend_stubs").join(version).join(stub), backend.join(stub))?;
        let lib = ["-c", "import sysconfig; print(sysconfig.get_config_var('LIBDIR'))"];
        let lib = Command::new(self.venv.join("bin/python")).args(lib).output()?.stdout;
        let libraries = format!(
            "{}:{}",
            self.packages.join("nvidia_pytriton.libs").display(),
            String::from_utf8(lib)?.trim()
        );
        let mut command = Command::new(server.join("bin/tritonserver"));
        command.arg("--model-repository").arg(self.sources.join("triton"));
        command.arg("--backend-directory").arg(&self.backends);
        command.args(["--http-address", "127.0.0.1", "--http-port", &port.to_string()]);
        command.args(["--allow-grpc", "false", "--allow-metrics", "false"]);
        command.env("LD_LIBRARY_PATH", libraries);
        Ok(command)
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let Some(process) = self.process.take() else { return };
        let group = Pid::from_child(&process.child);
        drop(process);
        // Some leave their workers behind; where none is left there is no such group.
        let _ = kill_process_group(group, Signal::KILL);
    }
}

/// Makes the environment of the peers.
fn make(venv: &Path, sources: &Path) -> Result<()> {
    eprintln!("making {FOLDER} with {}, as pip is set to find them", PEERS.join(", "));
    let mut python = Command::new("python3");
    let mut pip = Command::new(venv.join("bin/python"));
    pip.args(["-m", "pip", "install", "--disable-pip-version-check", "--requirement"]);
    for command in
        [python.args(["-m", "venv"]).arg(venv), pip.arg(sources.join("requirements.txt"))]
    {
        let status = command.status()?;
        ensure!(status.success(), "{} failed ({status})", command.get_program().display());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_peer_counts() {
        let mut found = BTreeMap::new();
        for (name, rate) in [("triton", 2.0), ("mosec", 4.0), ("litserve", 1.0), (OURS, 10.0)] {
            found.insert((name, "observe16_rps"), vec![rate; 3]);
            found.insert((name, "observe1_rps"), vec![1.0; 3]);
        }
        // Noise of a round hits all of it.
        for rates in found.values_mut() {
            rates[1] *= 3.0;
        }
        let figures = figures(&found);
        assert!((figures["observe16_vs_best_peer"] - 2.5).abs() < 1e-9);
        assert!((figures["mosec.observe16_rps"] - 4.0).abs() < 1e-9);
    }
}
