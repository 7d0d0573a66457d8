//! Programs that run beside the automation, and end with it.
//!
//! Whatever happens here, an error or Ctrl-C, no program is left behind: each is asked to end (SIGTERM) when it is
//! dropped, and made to if it does not within its time.

use std::path::PathBuf;
use std::process::{Child, Command};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use rustix::process::{Pid, Signal, kill_process};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

/// How often a program is looked at.
const LOOK: Duration = Duration::from_millis(20);

/// Remembers that Ctrl-C was pressed, or that this program was told to end.
#[derive(Clone, Debug)]
pub(crate) struct Interrupt(Arc<AtomicBool>);

impl Interrupt {
    /// From now on these signals do not end this program; whoever waits here has to look.
    pub(crate) fn watch() -> Result<Self> {
        let seen = Arc::new(AtomicBool::new(false));
        for signal in [SIGHUP, SIGINT, SIGTERM] {
            signal_hook::flag::register(signal, Arc::clone(&seen))?;
        }
        Ok(Self(seen))
    }

    /// Fails if there was one.
    pub(crate) fn check(&self) -> Result<()> {
        if self.0.load(Ordering::Relaxed) {
            bail!("interrupted");
        }
        Ok(())
    }
}

/// A program that ends with its owner.
#[derive(Debug)]
pub(crate) struct Running {
    pub(crate) child: Child,
    name: PathBuf,
    grace: Duration,
    left: bool,
}

impl Running {
    /// Starts a program, which has `grace` to end when it is told to.
    pub(crate) fn start(command: &mut Command, grace: Duration) -> Result<Self> {
        let name = PathBuf::from(command.get_program());
        let child =
            command.spawn().with_context(|| format!("{} cannot be started", name.display()))?;
        Ok(Self { child, name, grace, left: false })
    }

    /// Waits until it has ended by itself, well.
    pub(crate) fn wait(mut self, interrupt: &Interrupt) -> Result<()> {
        loop {
            if let Some(status) = self.child.try_wait()? {
                ensure!(status.success(), "{} failed ({status})", self.name.display());
                return Ok(());
            }
            interrupt.check()?;
            sleep(LOOK);
        }
    }

    /// Tells it to end, and waits until it has.
    pub(crate) fn stop(mut self) -> Result<()> {
        let status = self.end()?;
        ensure!(status.success(), "{} did not end well ({status})", self.name.display());
        Ok(())
    }

    /// Lets it go on alone; returns the id of its process.
    pub(crate) fn leave(mut self) -> u32 {
        self.left = true;
        self.child.id()
    }

    fn end(&mut self) -> Result<std::process::ExitStatus> {
        if let Some(status) = self.child.try_wait()? {
            return Ok(status);
        }
        kill_process(Pid::from_child(&self.child), Signal::TERM)?;
        let patience = Instant::now() + self.grace;
        while Instant::now() < patience {
            if let Some(status) = self.child.try_wait()? {
                return Ok(status);
            }
            sleep(LOOK);
        }
        self.child.kill()?;
        self.child.wait()?;
        bail!("{} did not end within {} s", self.name.display(), self.grace.as_secs())
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if self.left {
            return;
        }
        if let Err(error) = self.end() {
            eprintln!("warning: {error:#}");
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead as _, BufReader};
    use std::process::Stdio;

    use super::*;

    fn shell(script: &str, grace: u64) -> Running {
        let mut command = Command::new("sh");
        command.args(["-c", script]).stdout(Stdio::piped());
        let mut running = Running::start(&mut command, Duration::from_secs(grace)).unwrap();
        let mut line = String::new();
        BufReader::new(running.child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        assert_eq!(line, "ready\n");
        running
    }

    #[test]
    fn a_program_is_asked_to_end() {
        let script = "trap 'exit 0' TERM; echo ready; while :; do sleep 0.01; done";
        shell(script, 60).stop().unwrap();
    }

    #[test]
    fn a_program_that_does_not_listen_is_made_to_end() {
        let deaf = shell("trap '' TERM; echo ready; exec sleep 600", 0);
        let error = deaf.stop().unwrap_err().to_string();
        assert!(error.contains("did not end within"), "{error}");
    }

    #[test]
    fn a_program_that_is_left_goes_on() {
        let running = shell("echo ready; exec sleep 600", 1);
        let id = Pid::from_child(&running.child);
        running.leave();
        kill_process(id, Signal::KILL).unwrap();
    }

    #[test]
    fn how_a_program_ended_is_told() {
        let interrupt = Interrupt(Arc::new(AtomicBool::new(false)));
        shell("echo ready", 1).wait(&interrupt).unwrap();
        let error = shell("echo ready; exit 3", 1).wait(&interrupt).unwrap_err().to_string();
        assert!(error.contains("sh failed") && error.contains('3'), "{error}");
        interrupt.0.store(true, Ordering::Relaxed);
        let error = shell("echo ready; exec sleep 600", 1).wait(&interrupt).unwrap_err();
        assert_eq!(error.to_string(), "interrupted");
    }
}
