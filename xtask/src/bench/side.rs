//! A program that measures when it is told to.

use std::io::{BufRead as _, BufReader, Write as _};
use std::process::{ChildStdin, ChildStdout, Command, Stdio};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use fs_err as fs;

use crate::process::Running;

/// For programs to end in.
const GRACE: Duration = Duration::from_secs(10);

/// A program that answers each line on its standard input by a line of numbers.
pub(super) struct Side {
    name: &'static str,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
    program: Running,
}

/// What a program answered that makes a step as often as it can in its turn.
pub(super) struct Measured {
    /// Processor time of a step, in seconds.
    pub(super) seconds: f64,
    /// What the answer says besides how many steps were made.
    pub(super) said: Vec<f64>,
}

impl Side {
    pub(super) fn start(name: &'static str, command: &mut Command) -> Result<Self> {
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut program = Running::start(command, GRACE)?;
        let input = program.child.stdin.take().context("no standard input")?;
        let output = program.child.stdout.take().context("no standard output")?;
        Ok(Self { name, input, output: BufReader::new(output), program })
    }

    /// The numbers that a line is answered by.
    pub(super) fn ask(&mut self, line: &str) -> Result<Vec<f64>> {
        let mut answer = String::new();
        writeln!(self.input, "{line}")
            .and_then(|()| self.output.read_line(&mut answer))
            .with_context(|| format!("{} does not answer", self.name))?;
        ensure!(!answer.is_empty(), "{} ended", self.name);
        let numbers = answer.split_whitespace().map(str::parse).collect::<Result<Vec<f64>, _>>();
        let numbers = numbers.with_context(|| format!("{} answered {answer:?}", self.name))?;
        ensure!(!numbers.is_empty(), "{} answered nothing", self.name);
        Ok(numbers)
    }

    /// Processor time of a step, where the answer begins with how many were made.
    pub(super) fn measure(&mut self, line: &str) -> Result<Measured> {
        let before = self.processor_time()?;
        let numbers = self.ask(line)?;
        let seconds = (self.processor_time()? - before) / numbers[0];
        Ok(Measured { seconds, said: numbers[1..].to_vec() })
    }

    /// What its threads have used so far, in seconds.
    fn processor_time(&self) -> Result<f64> {
        let mut nanoseconds = 0;
        for thread in fs::read_dir(format!("/proc/{}/task", self.program.child.id()))? {
            let times = fs::read_to_string(thread?.path().join("schedstat"))?;
            let used = times.split(' ').next().and_then(|used| used.parse::<u64>().ok());
            nanoseconds += used.with_context(|| format!("{times:?} is no schedstat"))?;
        }
        Ok(Duration::from_nanos(nanoseconds).as_secs_f64())
    }
}
