//! A server of the service, as a process that ends with its owner.

use std::io::{BufRead as _, BufReader};
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::process::{ChildStdout, Command, Stdio};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread;
use std::time::Duration;

use anyhow::{Context as _, Result, bail};
use fs_err as fs;

use crate::process::{Interrupt, Running};

/// Longer than the server gives its requests to finish.
const GRACE: Duration = Duration::from_secs(30);

/// Lines of the server's log that are shown when it does not start.
const LAST_LINES: usize = 20;

/// A running server.
pub(crate) struct Server {
    pub(crate) process: Running,
    /// Where it listens, as URLs.
    pub(crate) grpc: String,
    pub(crate) http: String,
    pub(crate) admin: String,
}

impl Server {
    /// Starts a server on free ports of the loopback and waits until it serves.
    pub(crate) fn start(command: &mut Command, log: &Path, interrupt: &Interrupt) -> Result<Self> {
        let any = "127.0.0.1:0";
        command.args(["--grpc-listen", any, "--http-listen", any, "--admin-listen", any]);
        command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(fs::File::create(log)?.into_file());
        // Not in the terminal's group: Ctrl-C reaches this program, which then ends the server in order.
        command.process_group(0);
        let mut process = Running::start(command, GRACE)?;
        let stdout = process.child.stdout.take().context("the server has no standard output")?;
        let line = first_line(stdout, interrupt)?;
        let address = |name: &str| {
            let mut words = line.split_whitespace();
            words.find_map(|word| Some(format!("http://{}", word.strip_prefix(name)?)))
        };
        let (Some(grpc), Some(http), Some(admin)) =
            (address("grpc="), address("http="), address("admin="))
        else {
            let text = fs::read_to_string(log).unwrap_or_default();
            let from = text.lines().count().saturating_sub(LAST_LINES);
            let last: Vec<_> = text.lines().skip(from).collect();
            bail!("the server did not start; the end of {}:\n{}", log.display(), last.join("\n"));
        };
        Ok(Self { process, grpc, http, admin })
    }
}

/// The first line that a program writes; empty if it ends without one.
fn first_line(stdout: ChildStdout, interrupt: &Interrupt) -> Result<String> {
    let (sender, receiver) = channel();
    thread::Builder::new().name("server-output".to_owned()).spawn(move || {
        let mut line = String::new();
        let read = BufReader::new(stdout).read_line(&mut line);
        // Nobody listens any more after an interrupt.
        let _ = sender.send(read.map(|_| line));
    })?;
    loop {
        match receiver.recv_timeout(Duration::from_millis(50)) {
            Ok(line) => return Ok(line?),
            Err(RecvTimeoutError::Timeout) => interrupt.check()?,
            Err(RecvTimeoutError::Disconnected) => bail!("the server's output was not read"),
        }
    }
}
