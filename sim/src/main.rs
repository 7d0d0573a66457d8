//! `gatsbi-sim`: makes data sets of the simulated scenes, looks at them, and serves scenes to other programs.

mod progress;
mod table;

use std::{
    env,
    io::{self, Write as _},
    num::NonZeroUsize,
    os::unix::process::CommandExt as _,
    path::PathBuf,
    process::{self, ExitCode},
    thread,
};

use anyhow::Context as _;
use clap::{Args, Parser, Subcommand};
use gatsbi_episodes::Dataset;
use gatsbi_sim::{
    Error, Scene,
    generate::{Generation, generate},
    look::{SheetOptions, Statistics, sheet},
    serve::serve,
};

use crate::progress::Progress;

/// Simulated robot scenes: episodes with the truth about them, and environments to act in.
#[derive(Debug, Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Make a data set, or go on with one.
    Generate(Generate),
    /// Look at a data set: a sheet of frames and labels, and statistics.
    Look(Look),
    /// List the id, seed and state hash of each episode, to compare data sets of two machines.
    Hashes(Hashes),
    /// Serve one scene to the program that started this one, over standard input and output.
    Serve(Serve),
}

#[derive(Debug, Args)]
struct Generate {
    /// push1, push1-play, roll, roll-cycle, push2, balls3, balls6 or balls9.
    #[arg(long)]
    scene: Scene,
    /// Episodes that the data set shall have; those it has already are kept.
    #[arg(long)]
    episodes: u64,
    /// Of the data set: the same seed makes the same episodes.
    #[arg(long)]
    seed: u64,
    /// Folder of the data set.
    #[arg(long)]
    out: PathBuf,
    /// Height and width of the frames in pixels.
    #[arg(long, default_value_t = 64)]
    size: u32,
    /// Threads that make episodes; by default as many as the machine has cores.
    #[arg(long)]
    threads: Option<NonZeroUsize>,
    /// Size in MiB at which a file is closed; an interrupted run loses at most the one that is open.
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u16).range(1..=1024))]
    shard_mib: u16,
}

#[derive(Debug, Args)]
struct Look {
    /// Folder of the data set, or one of its files.
    dataset: PathBuf,
    /// Where the sheet goes, a PNG; by default beside the data set, under its name.
    #[arg(long)]
    sheet: Option<PathBuf>,
    /// Episodes on the sheet.
    #[arg(long, default_value_t = 4)]
    episodes: usize,
    /// Frames of each.
    #[arg(long, default_value_t = 10)]
    frames: usize,
    /// Size of a pixel on the sheet.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=16))]
    scale: u32,
    /// Print the statistics as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
struct Hashes {
    /// Folder of the data set, or one of its files.
    dataset: PathBuf,
}

#[derive(Debug, Args)]
struct Serve {
    /// push1, push1-play, roll, roll-cycle, push2, balls3, balls6 or balls9.
    #[arg(long)]
    scene: Scene,
    /// Height and width of the frames in pixels.
    #[arg(long, default_value_t = 64)]
    size: u32,
}

fn main() -> ExitCode {
    draw_on_one_thread();
    match run(Cli::parse().command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Starts the program over with Mesa's software renderer told to draw on the thread that asks. Else each of the threads
/// that make episodes would start as many more as there are cores, for pictures that are too small to share out.
fn draw_on_one_thread() {
    const SETTING: &str = "LP_NUM_THREADS";
    if env::var_os(SETTING).is_some() {
        return;
    }
    let Ok(program) = env::current_exe() else { return };
    // It returns only if it fails, and then the renderer is slower.
    let _failure =
        process::Command::new(program).args(env::args_os().skip(1)).env(SETTING, "0").exec();
}

fn run(command: Command) -> anyhow::Result<()> {
    match command {
        Command::Generate(arguments) => make(&arguments),
        Command::Look(arguments) => look(&arguments),
        Command::Hashes(arguments) => hashes(&arguments),
        Command::Serve(Serve { scene, size }) => {
            let mut scene = scene.open(size)?;
            Ok(serve(scene.as_mut(), io::stdin().lock(), io::stdout().lock())?)
        }
    }
}

fn make(arguments: &Generate) -> anyhow::Result<()> {
    let cores = || thread::available_parallelism().unwrap_or(NonZeroUsize::MIN);
    let generation = Generation {
        scene: arguments.scene,
        episodes: arguments.episodes,
        seed: arguments.seed,
        size: arguments.size,
        threads: arguments.threads.unwrap_or_else(cores),
        shard_bytes: usize::from(arguments.shard_mib) << 20,
    };
    let mut progress = Progress::new();
    let manifest = generate(&generation, &arguments.out, |done, all| progress.show(done, all))?;
    progress.finish();
    let bytes = manifest.shards.iter().map(|shard| shard.bytes).sum();
    print(&format!(
        "{}: {} episodes, {} frames, {}\n",
        arguments.out.display(),
        manifest.episodes,
        manifest.frames,
        indicatif::DecimalBytes(bytes)
    ))
}

fn look(arguments: &Look) -> anyhow::Result<()> {
    let dataset = Dataset::open(&arguments.dataset)?;
    let all = dataset.len() as u64;
    let mut progress = Progress::new();
    let statistics = Statistics::of(&dataset, |done| progress.show(done as u64, all))?;
    progress.finish();
    let Look { episodes, frames, scale, .. } = *arguments;
    let picture = sheet(&dataset, SheetOptions { episodes, frames, scale })?;
    let path =
        arguments.sheet.clone().unwrap_or_else(|| arguments.dataset.with_added_extension("png"));
    picture.save(&path).map_err(|source| Error::Picture { path: path.clone(), source })?;
    if arguments.json {
        print(&format!("{}\n", serde_json::to_string_pretty(&statistics)?))
    } else {
        print(&format!("{}\nthe sheet is {}\n", table::table(&statistics), path.display()))
    }
}

fn hashes(arguments: &Hashes) -> anyhow::Result<()> {
    let dataset = Dataset::open(&arguments.dataset)?;
    let mut lines = String::new();
    for episode in dataset.summaries()? {
        let seed = episode.seed.map_or("-".into(), |seed| seed.to_string());
        let hash = episode.state_hash.as_deref().unwrap_or("-");
        lines.push_str(&format!("{} {seed} {hash}\n", episode.id));
    }
    print(&lines)
}

/// Prints to standard output; a reader that has seen enough, such as `head`, is no failure.
fn print(text: &str) -> anyhow::Result<()> {
    match io::stdout().write_all(text.as_bytes()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        written => written.context("standard output"),
    }
}
