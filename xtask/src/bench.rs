//! What the service takes, beside what else could be used.
//!
//! First, steps of the Rust model beside its twin in PyTorch: same weights, one thread each, in turns. What counts is
//! processor time, which leaves out the time in which others had the core. Others still slow memory and caches down, so
//! the sides take turns at every step in every round, and the result is the median over the rounds of the ratio within
//! a round. The twin runs eagerly, in both memory formats, and the faster one counts; and for 64 imagined rows under
//! `torch.compile` too. What a step is, is said in `tests/load/engine/steps.rs` and
//! `tests/reference/gatsbi_twin/timing.py`.
//!
//! Then [`service`]: what sessions, batching and connections cost. [`peers`] puts other servers beside ours. `figures` has
//! the names and the sums of what is reported; `docs/performance.md` says what was learned from it.

mod figures;
mod peers;
mod service;
mod side;

use std::collections::BTreeMap;
use std::fmt;
use std::io::{IsTerminal as _, Write as _, stderr};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::Result;
use clap::Args;
use fs_err as fs;
use serde_json::{Value, json};

use self::side::Side;
use crate::cargo::{self, Programs};
use crate::libtorch::VERSION;
use crate::process::{Interrupt, Running};
use crate::{setup, twin};

const PRESETS: [&str; 2] = ["tiny", "push1"];
const BATCHES: [usize; 4] = [1, 8, 64, 256];
const STEPS: [&str; 3] = ["observe", "imagine", "train"];

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
    /// Measure only the steps of the model, only the service, or only the service beside other servers; by default the first two
    #[arg(long, value_enum)]
    only: Option<Part>,
    /// Measure the service beside Triton, mosec and LitServe with the twin behind them: the same as --only peers
    ///
    /// Makes .venv-peers with them from where pip is set to find them, unless it is there.
    #[arg(long, conflicts_with = "only")]
    peers: bool,
    /// Measure the dev profile, in which only the model is optimised: spares compiling libtorch's bindings once more
    #[arg(long)]
    dev: bool,
}

#[derive(Clone, Copy, PartialEq, clap::ValueEnum)]
enum Part {
    Steps,
    Service,
    Peers,
}

/// What is measured with.
struct Tools<'a> {
    root: &'a Path,
    programs: Programs,
    python: PathBuf,
    /// Holds an untrained checkpoint of each preset.
    folder: tempfile::TempDir,
    interrupt: Interrupt,
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
    /// Under `torch.compile`, where that is measured.
    compiled: Option<f64>,
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

/// Measures, prints tables, writes the file.
pub(crate) fn bench(root: &Path, arguments: &Arguments) -> Result<()> {
    setup::ensure_set_up(root)?;
    let python = twin::python(root)?;
    let profile = if arguments.dev { "" } else { "--release " };
    let programs = cargo::build(
        root,
        &format!(
            "build {profile}--workspace --locked --bin gatsbi-server --bin gatsbi-train \
             --bin gatsbi-load --bin gatsbi-load-engine"
        ),
    )?;
    let folder = tempfile::tempdir()?;
    let tools = Tools { root, programs, python, folder, interrupt: Interrupt::watch()? };
    for preset in PRESETS {
        let mut init = Command::new(tools.programs.named("gatsbi-train")?);
        init.args(["init", "--preset", preset, "--seed", "1", "--out"]);
        init.arg(tools.checkpoint(preset)).stdout(Stdio::null());
        Running::start(&mut init, GRACE)?.wait(&tools.interrupt)?;
    }
    let only = if arguments.peers { Some(Part::Peers) } else { arguments.only };
    let (mut figures, mut lines) = (BTreeMap::new(), Vec::new());
    if only.is_none_or(|only| only == Part::Steps) {
        lines = steps(&tools, arguments)?;
        print(&lines, arguments.rounds);
        figures.extend(figures::figures(&lines));
    }
    if only.is_none_or(|only| only == Part::Service) {
        figures.extend(service::measure(&tools, arguments)?);
    }
    if only == Some(Part::Peers) {
        figures.extend(peers::measure(&tools, arguments)?);
    }
    figures::print(&figures);
    if let Some(path) = &arguments.json {
        let lines: Vec<_> = lines.iter().map(Line::record).collect();
        let record = json!({
            "torch": VERSION,
            "processor": processor(),
            "profile": if arguments.dev { "dev" } else { "release" },
            "load": fs::read_to_string("/proc/loadavg")?.trim(),
            "figures": figures,
            "steps": lines,
        });
        fs::write(path, format!("{record:#}\n"))?;
    }
    Ok(())
}

/// Steps of the model and its twins, on one thread each, in turns.
fn steps(tools: &Tools<'_>, arguments: &Arguments) -> Result<Vec<Line>> {
    let mut engine = Command::new(tools.programs.named("gatsbi-load-engine")?);
    let mut rust = Side::start("the Rust model", engine.arg("steps"))?;
    let twin = |flags: &[&str]| {
        let mut command = Command::new(&tools.python);
        command.args(["-m", "gatsbi_twin.timing"]).args(flags);
        Side::start("the twin", &mut command)
    };
    let mut channels_last = twin(&[])?;
    let mut contiguous = twin(&["--contiguous"])?;
    let mut compiled = twin(&["--compile"])?;

    let rounds = arguments.rounds;
    let (seconds, batches) =
        if arguments.quick { (0.1, &BATCHES[..2]) } else { (0.5, &BATCHES[..]) };
    let mut lines = lines(batches);
    for round in 0..=rounds {
        for line in &mut lines {
            tools.interrupt.check()?;
            progress(&format!("round {round} of {rounds}: {line}"));
            let Line { batch, step, .. } = *line;
            let time = if round == 0 { 0.0 } else { seconds };
            let file = tools.checkpoint(line.preset);
            let request = format!("{} {batch} {step} {time}", file.display());
            let ours = rust.measure(&request)?;
            let (mut beside, mut compiling) = (None, None);
            if batch == 64 && step == "imagine" {
                let mut also = |batch: usize, step: &str| {
                    rust.measure(&format!("{} {batch} {step} {time}", file.display()))
                };
                let (many, multiply) = (also(MANY, "imagine")?, also(1, "multiply")?);
                beside = Some(Beside {
                    many: many.seconds,
                    multiply: multiply.said[0] / multiply.seconds,
                    macs: ours.said[0],
                    state: ours.said[1],
                });
                compiling = Some(compiled.measure(&request)?.seconds);
            }
            let twin = [channels_last.measure(&request)?, contiguous.measure(&request)?];
            let twin = twin.map(|twin| twin.seconds);
            let measured = Round { rust: ours.seconds, twin, compiled: compiling, beside };
            // The first has loaded the model and made the batch.
            line.rounds.extend((round > 0).then_some(measured));
        }
    }
    progress("");
    Ok(lines)
}

impl Tools<'_> {
    fn checkpoint(&self, preset: &str) -> PathBuf {
        self.folder.path().join(preset)
    }

    /// Loads the service at `url`, or the peer of that name.
    fn load(&self, peer: Option<&str>, url: &str) -> Result<Side> {
        let mut command = Command::new(self.programs.named("gatsbi-load")?);
        command.args(["turns", "--server", url]);
        if let Some(peer) = peer {
            // It is asked again and again while the peer starts.
            command.args(["--peer", peer]).stderr(Stdio::null());
        }
        Side::start("the load", &mut command)
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
            "twin_compiled_seconds": self.rounds.iter().map(|round| round.compiled).collect::<Vec<_>>(),
            "twin_format": FORMATS[self.format()],
            "ratio_quartiles": self.ratio(),
        })
    }
}

fn lines(batches: &[usize]) -> Vec<Line> {
    let mut lines = Vec::new();
    for preset in PRESETS {
        for &batch in batches {
            // Nobody observes hundreds of sessions at once, and recipes train on eight sequences.
            let steps = STEPS.into_iter().filter(|step| match *step {
                "observe" => batch <= 64,
                "train" => batch == 8,
                _ => true,
            });
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

/// The middle one of some numbers.
fn median(mut numbers: Vec<f64>) -> f64 {
    numbers.sort_by(f64::total_cmp);
    numbers[(numbers.len() - 1) / 2]
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
            Round { rust: 2.0 * noise, twin, compiled: None, beside: None }
        };
        line.rounds = [1.0, 3.0, 1.5].map(round).into();
        assert_eq!(FORMATS[line.format()], "contiguous");
        assert!(line.ratio().iter().all(|ratio| (ratio - 2.5).abs() < 1e-12));
        assert!((line.median(|round| round.rust) - 3.0).abs() < 1e-12);
    }
}
