//! Time of the Rust model's steps beside its twin in PyTorch: same weights, one thread each, in turns.
//!
//! What counts is processor time, which leaves out the time in which others had the core. Others still slow memory and
//! caches down, so the sides take turns at every step in every round, and the result is the median over the rounds of the
//! ratio within a round. The twin runs eagerly, in both memory formats, and the faster one counts. What a step is, is
//! said in `models/examples/timing.rs` and `tests/reference/gatsbi_twin/timing.py`.
//! `figures` has the names and the sums of what is reported; `docs/performance.md` says what was learned from it.

mod figures;

use std::fmt;
use std::io::{BufRead as _, BufReader, IsTerminal as _, Write as _, stderr};
use std::path::{Path, PathBuf};
use std::process::{ChildStdin, ChildStdout, Command, Stdio};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use fs_err as fs;
use serde_json::{Value, json};

use crate::cargo;
use crate::libtorch::VERSION;
use crate::process::{Interrupt, Running};
use crate::{setup, twin};

const PRESETS: [&str; 2] = ["tiny", "push1"];
const BATCHES: [usize; 4] = [1, 8, 64, 256];
const STEPS: [&str; 2] = ["observe", "imagine"];

/// The twin's memory formats, in the order of its sides.
const FORMATS: [&str; 2] = ["channels-last", "contiguous"];

/// Rows whose cost shows whether a large batch costs more than its parts.
const MANY: usize = 512;

/// For programs to end in.
const GRACE: Duration = Duration::from_secs(10);

#[derive(Args)]
pub(crate) struct Arguments {
    /// Write all numbers to this file
    #[arg(long, value_name = "OUT")]
    json: Option<PathBuf>,
    /// Short turns, and no batches beyond 8
    #[arg(long)]
    quick: bool,
    /// Rounds
    #[arg(long, value_name = "N", default_value_t = 9, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Measure the dev profile, in which only the model is optimised: spares compiling libtorch's bindings once more
    #[arg(long)]
    dev: bool,
}

/// A program that makes steps when it is told to.
struct Side {
    name: &'static str,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
    program: Running,
}

/// One step of one model with one size of batch.
struct Line {
    preset: &'static str,
    batch: usize,
    step: &'static str,
    rounds: Vec<Round>,
}

/// Seconds of processor time of a step.
#[derive(Clone, Copy)]
struct Round {
    rust: f64,
    /// In each of [`FORMATS`].
    twin: [f64; 2],
    /// Measured beside 64 imagined rows.
    beside: Option<Beside>,
}

/// What else a round of 64 imagined rows measures.
#[derive(Clone, Copy)]
struct Beside {
    /// Seconds of processor time of [`MANY`] imagined rows.
    many: f64,
    /// Multiply-accumulates a second of a product of matrices.
    multiply: f64,
    /// Multiply-accumulates of the 64 rows.
    macs: f64,
    /// Bytes of a session's state.
    state: f64,
}

/// What a program answered.
struct Measured {
    /// Processor time of a step.
    seconds: f64,
    /// What the answer says besides how many steps were made.
    said: Vec<f64>,
}

/// Measures, prints a table, writes the file.
pub(crate) fn bench(root: &Path, arguments: &Arguments) -> Result<()> {
    setup::ensure_set_up(root)?;
    let python = twin::python(root)?;
    let trainer = cargo::build(root, "build --workspace --locked --bin gatsbi-train")?;
    let timing = cargo::build(
        root,
        if arguments.dev {
            "build --workspace --locked --example timing"
        } else {
            "build --release --locked --package gatsbi-models --example timing"
        },
    )?;
    let interrupt = Interrupt::watch()?;

    let folder = tempfile::tempdir()?;
    let file = |preset: &str| folder.path().join(preset);
    for preset in PRESETS {
        let mut init = Command::new(trainer.named("gatsbi-train")?);
        init.args(["init", "--preset", preset, "--seed", "1", "--out"]).arg(file(preset));
        Running::start(init.stdout(Stdio::null()), GRACE)?.wait(&interrupt)?;
    }
    let mut rust = Side::start("the Rust model", &mut Command::new(timing.named("timing")?))?;
    let twin = || {
        let mut command = Command::new(&python);
        command.args(["-m", "gatsbi_twin.timing"]);
        command
    };
    let mut channels_last = Side::start("the twin", &mut twin())?;
    let mut contiguous = Side::start("the twin", twin().arg("--contiguous"))?;

    let rounds = arguments.rounds;
    let (seconds, batches) =
        if arguments.quick { (0.1, &BATCHES[..2]) } else { (0.5, &BATCHES[..]) };
    let mut lines = lines(batches);
    for round in 0..=rounds {
        for line in &mut lines {
            interrupt.check()?;
            progress(&format!("round {round} of {rounds}: {line}"));
            let Line { batch, step, .. } = *line;
            let time = if round == 0 { 0.0 } else { seconds };
            let request = format!("{} {batch} {step} {time}", file(line.preset).display());
            let ours = rust.measure(&request)?;
            let beside = if batch == 64 && step == "imagine" {
                let mut also = |batch: usize, step: &str| {
                    rust.measure(&format!("{} {batch} {step} {time}", file(line.preset).display()))
                };
                let (many, multiply) = (also(MANY, "imagine")?, also(1, "multiply")?);
                Some(Beside {
                    many: many.seconds,
                    multiply: multiply.said[0] / multiply.seconds,
                    macs: ours.said[0],
                    state: ours.said[1],
                })
            } else {
                None
            };
            let twin = [channels_last.measure(&request)?, contiguous.measure(&request)?];
            let twin = twin.map(|twin| twin.seconds);
            let measured = Round { rust: ours.seconds, twin, beside };
            // The first has loaded the model and made the batch.
            line.rounds.extend((round > 0).then_some(measured));
        }
    }
    progress("");
    print(&lines, rounds);
    let figures = figures::figures(&lines);
    figures::print(&figures);
    if let Some(path) = &arguments.json {
        let lines: Vec<_> = lines.iter().map(Line::record).collect();
        let record = json!({
            "torch": VERSION,
            "threads": 1,
            "processor": processor(),
            "profile": if arguments.dev { "dev" } else { "release" },
            "figures": figures,
            "steps": lines,
        });
        fs::write(path, format!("{record:#}\n"))?;
    }
    Ok(())
}

impl Side {
    fn start(name: &'static str, command: &mut Command) -> Result<Self> {
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut program = Running::start(command, GRACE)?;
        let input = program.child.stdin.take().context("no standard input")?;
        let output = program.child.stdout.take().context("no standard output")?;
        Ok(Self { name, input, output: BufReader::new(output), program })
    }

    /// Processor time of a step in seconds, as a mean over those that it can make in its turn.
    fn measure(&mut self, request: &str) -> Result<Measured> {
        let before = self.processor_time()?;
        let mut answer = String::new();
        writeln!(self.input, "{request}")
            .and_then(|()| self.output.read_line(&mut answer))
            .with_context(|| format!("{} does not answer", self.name))?;
        ensure!(!answer.is_empty(), "{} ended", self.name);
        let numbers = answer.split_whitespace().map(str::parse).collect::<Result<Vec<f64>, _>>();
        let numbers = numbers.with_context(|| format!("{} answered {answer:?}", self.name))?;
        let (made, said) = numbers.split_first().context("an answer begins with a number")?;
        Ok(Measured { seconds: (self.processor_time()? - before) / made, said: said.to_vec() })
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

impl fmt::Display for Line {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { preset, batch, step, .. } = self;
        write!(f, "{preset}, {batch} rows, {step}")
    }
}

impl Line {
    /// Lower quartile, median and upper quartile over the rounds.
    fn quartiles(&self, of: impl Fn(&Round) -> f64) -> [f64; 3] {
        let mut numbers: Vec<f64> = self.rounds.iter().map(of).collect();
        numbers.sort_by(f64::total_cmp);
        let last = numbers.len() - 1;
        [last / 4, last / 2, last - last / 4].map(|at| numbers[at])
    }

    fn median(&self, of: impl Fn(&Round) -> f64) -> f64 {
        self.quartiles(of)[1]
    }

    /// The twin's faster format.
    fn format(&self) -> usize {
        let [channels_last, contiguous] = [0, 1].map(|at| self.median(|round| round.twin[at]));
        usize::from(contiguous < channels_last)
    }

    /// How many times as long the twin takes, in quartiles.
    fn ratio(&self) -> [f64; 3] {
        let format = self.format();
        self.quartiles(|round| round.twin[format] / round.rust)
    }

    fn record(&self) -> Value {
        let all = |of: &dyn Fn(&Round) -> f64| self.rounds.iter().map(of).collect::<Vec<_>>();
        json!({
            "preset": self.preset,
            "batch": self.batch,
            "step": self.step,
            "rust_seconds": all(&|round| round.rust),
            "twin_channels_last_seconds": all(&|round| round.twin[0]),
            "twin_contiguous_seconds": all(&|round| round.twin[1]),
            "twin_format": FORMATS[self.format()],
            "ratio_quartiles": self.ratio(),
        })
    }
}

fn lines(batches: &[usize]) -> Vec<Line> {
    let mut lines = Vec::new();
    for preset in PRESETS {
        for &batch in batches {
            // Nobody observes hundreds of sessions at once.
            let steps = STEPS.into_iter().filter(|step| batch <= 64 || *step == "imagine");
            lines.extend(steps.map(|step| Line { preset, batch, step, rounds: Vec::new() }));
        }
    }
    lines
}

#[expect(clippy::print_stdout, reason = "the table is what one runs it to see")]
fn print(lines: &[Line], rounds: u32) {
    println!(
        "milliseconds of processor time of a step on {}\n\
         medians of {rounds} rounds, of which half lie in the range",
        processor()
    );
    println!(
        "{:<8}{:>6}  {:<8}{:>10}{:>10}{:>13}  {:<12}  twin's format",
        "preset", "batch", "step", "rust", "twin", "twin / rust", "range"
    );
    for line in lines {
        let (format, [low, ratio, high]) = (line.format(), line.ratio());
        println!(
            "{:<8}{:>6}  {:<8}{:>10.2}{:>10.2}{ratio:>13.2}  {:<12}  {}",
            line.preset,
            line.batch,
            line.step,
            1e3 * line.median(|round| round.rust),
            1e3 * line.median(|round| round.twin[format]),
            format!("{low:.2} to {high:.2}"),
            FORMATS[format]
        );
    }
}

/// What is being done now, in a terminal.
fn progress(what: &str) {
    let mut terminal = stderr();
    if terminal.is_terminal() {
        // Nothing is lost if it cannot be shown.
        let _ = write!(terminal, "\r\x1b[2K{what}").and_then(|()| terminal.flush());
    }
}

fn processor() -> String {
    let described = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = described.lines().find_map(|line| line.strip_prefix("model name"));
    name.map_or("a processor without name", |name| name.trim_start_matches([' ', '\t', ':']))
        .to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_that_hits_both_sides_leaves_the_ratio() {
        let mut line = lines(&[1]).remove(0);
        let round = |noise: f64| {
            let twin = [7.0 * noise, 5.0 * noise];
            Round { rust: 2.0 * noise, twin, beside: None }
        };
        line.rounds = [1.0, 3.0, 1.5].map(round).into();
        assert_eq!(FORMATS[line.format()], "contiguous");
        assert!(line.ratio().iter().all(|ratio| (ratio - 2.5).abs() < 1e-12));
        assert!((line.median(|round| round.rust) - 3.0).abs() < 1e-12);
    }
}
