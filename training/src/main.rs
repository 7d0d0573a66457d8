//! `gatsbi-train`: makes, trains and evaluates checkpoints.

#![expect(clippy::print_stdout, reason = "a command-line program speaks to people")]

use std::{
    ops::Range,
    path::{Path, PathBuf},
};

use anyhow::{Context as _, bail, ensure};
use clap::{Args, Parser, Subcommand};
use gatsbi_episodes::Dataset;
use gatsbi_models::{
    checkpoint::{Checkpoint, Precision},
    config::presets,
    gatsbi::world::GatsbiWorld,
    world_model::WorldModel as _,
};
use gatsbi_training::{
    ablation::{self, Ablation},
    clips::Clips,
    evaluation::{
        CONDITIONING, Draw, Recorded,
        perceptual::Perceptual,
        picture, plot,
        report::{Protocol, report},
        rollout, wanted,
    },
    recipe::Recipe,
    trainer::Trainer,
    untrained,
    variant::Variant,
};
use indicatif::ProgressBar;
use tch::Device;

/// Steps imagined by an evaluation.
const HORIZON: usize = 15;

/// Makes, trains and evaluates GATSBI checkpoints.
#[derive(Debug, Parser)]
#[command(version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Write a checkpoint with untrained weights.
    Init {
        /// Sizes: roll, push1, push2, bair, balls, tiny or balls-tiny.
        #[arg(long, default_value = "tiny")]
        preset: String,
        /// Seed of the initial weights.
        #[arg(long, default_value_t = 0)]
        seed: u64,
        /// File to write.
        #[arg(long)]
        out: PathBuf,
    },
    /// Train a checkpoint by a recipe.
    Train {
        /// Recipe: a file, or roll, push1, push2, bair, balls, tiny, push1-tiny, roll-tiny, balls-tiny, or one that goes on from them (training/recipes).
        #[arg(long)]
        recipe: String,
        /// Data set.
        #[arg(long)]
        episodes: PathBuf,
        /// Episodes from and up to (excluded).
        #[arg(long, num_args = 2)]
        range: Option<Vec<usize>>,
        /// Seed.
        #[arg(long, default_value_t = 0)]
        seed: u64,
        /// Folder of the run.
        #[arg(long)]
        out: PathBuf,
        /// Checkpoint whose weights to start from.
        #[arg(long)]
        from: Option<PathBuf>,
        /// Where to train: cpu, or cuda:N.
        #[arg(long, default_value = "cpu", value_parser = device)]
        device: Device,
    },
    /// Train variants of a recipe for the same steps, and print the table of what they reach.
    ///
    /// A run that was stopped goes on; one that is done is measured again.
    Ablate {
        /// Recipe: a file, or roll, push1, push2, bair, balls, tiny, push1-tiny, roll-tiny, balls-tiny, or one that goes on from them (training/recipes).
        #[arg(long)]
        recipe: String,
        /// Variants to compare.
        #[arg(long, value_delimiter = ',', required = true)]
        variants: Vec<Variant>,
        /// Data set.
        #[arg(long)]
        episodes: PathBuf,
        /// Episodes to train on, from and up to (excluded).
        #[arg(long, num_args = 2, required = true)]
        range: Vec<usize>,
        /// Episodes to measure on, from and up to (excluded).
        #[arg(long, num_args = 2, required = true)]
        test: Vec<usize>,
        /// Steps that each variant is trained for; those of the recipe at most.
        #[arg(long)]
        steps: u64,
        /// Seed of every run.
        #[arg(long, default_value_t = 0)]
        seed: u64,
        /// Folder: a run per variant, and table.md.
        #[arg(long)]
        out: PathBuf,
        /// Checkpoint whose weights every variant starts from, as far as it and all of them have them.
        #[arg(long)]
        from: Option<PathBuf>,
        /// Where to train: cpu, or cuda:N.
        #[arg(long, default_value = "cpu", value_parser = device)]
        device: Device,
    },
    /// Measure a checkpoint.
    Eval {
        /// Checkpoint.
        #[arg(long)]
        checkpoint: PathBuf,
        /// Data set.
        #[arg(long)]
        episodes: PathBuf,
        /// Episodes from and up to (excluded).
        #[arg(long, num_args = 2)]
        range: Option<Vec<usize>>,
        #[command(flatten)]
        evaluation: Evaluation,
    },
}

/// What an evaluation measures, and what it leaves.
#[derive(Args, Debug)]
struct Evaluation {
    /// Sampled rollouts of each episode, of which the best counts.
    #[arg(long, default_value_t = 10)]
    samples: u32,
    /// Weights of the perceptual metrics, from `cargo xtask metrics`: adds ST-LPIPS and the Fréchet video distance,
    /// which takes minutes.
    #[arg(long)]
    perceptual: Option<PathBuf>,
    /// File for all numbers.
    #[arg(long)]
    json: Option<PathBuf>,
    /// File for the numbers of each imagined step.
    #[arg(long)]
    csv: Option<PathBuf>,
    /// SVG of the numbers over imagined steps.
    #[arg(long)]
    plot: Option<PathBuf>,
    /// Picture of three episodes.
    #[arg(long)]
    picture: Option<PathBuf>,
}

fn main() -> anyhow::Result<()> {
    match Arguments::parse().command {
        Command::Init { preset, seed, out } => {
            let Some(config) = presets::preset(&preset) else {
                bail!("there is no preset {preset}; known are {}", presets::NAMES.join(", "));
            };
            let actions = untrained::plain_actions(config.action.dim);
            let header = untrained::header(&format!("{preset}-untrained"), config, actions, seed);
            Checkpoint::untrained(header, Device::Cpu)
                .save(&out, Precision::Single)
                .context("the checkpoint was not written")?;
            println!("{} (untrained, seed {seed})", out.display());
        }
        Command::Train { recipe, episodes, range, seed, out, from, device } => {
            tch::set_num_threads(1);
            let recipe = Recipe::load(&recipe)?;
            let dataset = Dataset::open(&episodes)?;
            let range = episodes_in(&dataset, range)?;
            let clips = clips(&dataset, range.clone(), from.as_deref())?;
            let data = data_name(&dataset, &range);
            let mut trainer = Trainer::open(recipe, &clips, &data, seed, &out, device)?;
            if let Some(from) = from {
                trainer.start_from(&from, |_| true)?;
            }
            trainer.run(&clips, None)?;
        }
        Command::Ablate {
            recipe,
            variants,
            episodes,
            range,
            test,
            steps,
            seed,
            out,
            from,
            device,
        } => {
            tch::set_num_threads(1);
            let recipe = Recipe::load(&recipe)?;
            let dataset = Dataset::open(&episodes)?;
            let range = episodes_in(&dataset, Some(range))?;
            let test = episodes_in(&dataset, Some(test))?;
            ensure!(
                test.end <= range.start || range.end <= test.start,
                "variants are trained on {range:?} and measured on {test:?}, expected no episode \
                 in both"
            );
            let clips = clips(&dataset, range.clone(), from.as_deref())?;
            let data = data_name(&dataset, &range);
            let ablation = Ablation {
                recipe: &recipe,
                steps,
                clips: &clips,
                data: &data,
                seed,
                from: from.as_deref(),
                device,
                test: (&dataset, test),
                horizon: HORIZON,
            };
            let measured = ablation.measure(&variants, &out, |measured| {
                Ok(fs_err::write(out.join("table.md"), ablation::table(measured))?)
            })?;
            print!("{}", ablation::table(&measured));
        }
        Command::Eval { checkpoint, episodes, range, evaluation } => {
            tch::set_num_threads(1);
            evaluate(&checkpoint, &episodes, range, &evaluation)?;
        }
    }
    Ok(())
}

fn device(text: &str) -> Result<Device, String> {
    match (text, text.strip_prefix("cuda:").map(str::parse)) {
        ("cpu", _) => Ok(Device::Cpu),
        (_, Some(Ok(index))) if tch::Cuda::is_available() => Ok(Device::Cuda(index)),
        (_, Some(Ok(_))) => Err("this libtorch sees no CUDA device".to_owned()),
        _ => Err("expected cpu or cuda:N".to_owned()),
    }
}

/// Reads what is trained on, with actions scaled as the checkpoint that a run starts from takes them.
fn clips(dataset: &Dataset, range: Range<usize>, from: Option<&Path>) -> anyhow::Result<Clips> {
    let from = from.map(|path| Checkpoint::load(path, Device::Cpu)).transpose()?;
    Clips::read(dataset, range, from.as_ref().map(|from| from.header.actions.as_slice()))
}

fn data_name(dataset: &Dataset, range: &Range<usize>) -> String {
    format!("{} episodes {}..{}", dataset.info().name, range.start, range.end)
}

/// The asked range of episodes, all without one.
fn episodes_in(dataset: &Dataset, range: Option<Vec<usize>>) -> anyhow::Result<Range<usize>> {
    let range = range.map_or(0..dataset.len(), |range| range[0]..range[1]);
    ensure!(
        !range.is_empty() && range.end <= dataset.len(),
        "there are no episodes {} up to {}, the data set has {}",
        range.start,
        range.end,
        dataset.len()
    );
    Ok(range)
}

fn evaluate(
    checkpoint: &Path,
    episodes: &Path,
    range: Option<Vec<usize>>,
    wants: &Evaluation,
) -> anyhow::Result<()> {
    let world = GatsbiWorld::load(checkpoint, Device::Cpu)?;
    let dataset = Dataset::open(episodes)?;
    let range = episodes_in(&dataset, range)?;
    let bar = ProgressBar::new(range.len() as u64);
    let perceptual = wants.perceptual.as_deref().map(|path| Perceptual::load(path, Device::Cpu));
    let perceptual = perceptual.transpose()?;
    let protocol =
        Protocol { horizon: HORIZON, samples: wants.samples, perceptual: perceptual.as_ref() };
    let report = report(&world, &dataset, range.clone(), protocol, |done| bar.inc(done as u64))?;
    bar.finish_and_clear();
    println!("{} on {}", report.model["name"], report.data);
    for (name, value) in report.numbers.iter().filter(|(name, _)| !name.ends_with("_ci95")) {
        let interval = report.numbers.get(&format!("{name}_ci95"));
        let interval = interval.map(|half| format!(" ± {half:.4}")).unwrap_or_default();
        println!("{name:<28} {value:>9.4}{interval}");
    }
    if let Some(path) = &wants.json {
        fs_err::write(path, serde_json::to_string_pretty(&report)?)?;
    }
    if let Some(path) = &wants.csv {
        fs_err::write(path, report.csv())?;
    }
    if let Some(path) = &wants.plot {
        plot::write(path, &report)?;
    }
    if let Some(path) = &wants.picture {
        let episodes: Vec<usize> = range.step_by(3).take(3).collect();
        let neutral = world.spec().neutral_action();
        let length = CONDITIONING + HORIZON;
        let recorded = Recorded::read(&dataset, &episodes, length, &neutral, Device::Cpu)?;
        let actions = &recorded.actions;
        let scenes = rollout(&world, &recorded, CONDITIONING, actions, Draw::Mean, wanted());
        picture::write(path, &recorded, &scenes, world.spec().agent_slot, 1)?;
    }
    Ok(())
}
