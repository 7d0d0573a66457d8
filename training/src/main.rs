//! `gatsbi-train`: makes, trains and evaluates checkpoints.

#![expect(clippy::print_stdout, reason = "a command-line program speaks to people")]

use std::path::PathBuf;

use anyhow::{Context as _, bail};
use clap::{Parser, Subcommand};
use gatsbi_models::{
    checkpoint::{Checkpoint, Precision},
    config::presets,
};
use gatsbi_episodes::Dataset;
use gatsbi_training::{clips::Clips, recipe::Recipe, trainer::Trainer, untrained};
use tch::Device;

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
        /// Sizes: roll, push1, push2, bair, balls or tiny.
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
        /// Recipe file.
        #[arg(long)]
        recipe: PathBuf,
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
        /// Picture to write.
        #[arg(long)]
        picture: Option<PathBuf>,
    },
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
        Command::Train { recipe, episodes, range, seed, out, from } => {
            tch::set_num_threads(1);
            let recipe: Recipe = toml::from_str(&fs_err::read_to_string(recipe)?)?;
            let dataset = Dataset::open(&episodes)?;
            let range = range.map_or(0..dataset.len(), |range| range[0]..range[1]);
            let clips = Clips::read(&dataset, range.clone())?;
            let data = format!("{} episodes {}..{}", dataset.info().name, range.start, range.end);
            let mut trainer = Trainer::open(recipe, &clips, &data, seed, &out, Device::Cpu)?;
            if let Some(from) = from {
                trainer.start_from(&from)?;
            }
            trainer.run(&clips, None)?;
        }
        Command::Eval { checkpoint, episodes, range, picture } => {
            tch::set_num_threads(1);
            evaluate(&checkpoint, &episodes, range, picture)?;
        }
    }
    Ok(())
}

fn evaluate(
    checkpoint: &std::path::Path,
    episodes: &std::path::Path,
    range: Option<Vec<usize>>,
    picture: Option<PathBuf>,
) -> anyhow::Result<()> {
    use gatsbi_models::{gatsbi::world::GatsbiWorld, world_model::WorldModel as _};
    use gatsbi_training::evaluation::{CONDITIONING, Recorded, decomposition, psnr, rollout, wanted};
    let world = GatsbiWorld::load(checkpoint, Device::Cpu)?;
    let dataset = Dataset::open(episodes)?;
    let range = range.map_or(0..dataset.len(), |range| range[0]..range[1]);
    let indices: Vec<usize> = range.collect();
    let neutral = world.spec().neutral_action();
    let agent = world.spec().agent_slot.unwrap_or(0);
    let mut iou = [Vec::new(), Vec::new()];
    let mut bg = [Vec::new(), Vec::new()];
    let mut counts = [decomposition::ObjectCounts::default(); 2];
    let (mut gain, mut action_gain, mut observed_psnr, mut imagined_psnr) = (vec![], vec![], vec![], vec![]);
    for (chunk_index, chunk) in indices.chunks(10).enumerate() {
        let recorded = Recorded::read(&dataset, chunk, 20, &neutral, Device::Cpu)?;
        let scenes = rollout(&world, &recorded, &recorded.actions, wanted());
        let mut other = Vec::new();
        for (t, action) in recorded.actions.iter().enumerate() {
            other.push(if t < CONDITIONING { action.shallow_clone() } else { action.roll([1i64].as_slice(), [0i64].as_slice()) });
        }
        let others = rollout(&world, &recorded, &other, wanted());
        if let (Some(path), 0) = (&picture, chunk_index) {
            gatsbi_training::evaluation::picture::write(path, &Recorded{frames: recorded.frames.iter().map(|f| f.narrow(0,0,3.min(f.size()[0]))).collect(), actions: vec![], labels: None}, &scenes, world.spec().agent_slot, 1)?;
        }
        let copy = &recorded.frames[CONDITIONING - 1];
        for (t, scene) in scenes.iter().enumerate() {
            let imagined = usize::from(t >= CONDITIONING);
            let truth = &recorded.frames[t];
            let own: Vec<f32> = psnr(scene.frame.as_ref().unwrap(), truth).try_into()?;
            let copied: Vec<f32> = psnr(copy, truth).try_into()?;
            let swapped: Vec<f32> = psnr(others[t].frame.as_ref().unwrap(), truth).try_into()?;
            if imagined == 1 {
                gain.extend(own.iter().zip(&copied).map(|(a, b)| a - b));
                imagined_psnr.extend(own.iter().copied());
                if t >= CONDITIONING + 4 {
                    action_gain.extend(own.iter().zip(&swapped).map(|(a, b)| a - b));
                }
            } else {
                observed_psnr.extend(own.iter().copied());
            }
            let labels = &recorded.labels.as_ref().unwrap()[t];
            let seg = decomposition::segmentation(scene);
            iou[imagined].extend(decomposition::iou(&seg.eq(agent), &labels.eq(1)));
            let slots = world.spec().slots;
            bg[imagined].extend(decomposition::iou(&seg.lt(slots).logical_and(&seg.ne(agent)), &labels.eq(0)));
            for row in 0..chunk.len() as i64 {
                let (c, _) = decomposition::match_objects(scene, labels, row);
                let total = &mut counts[imagined];
                total.truth += c.truth; total.found += c.found; total.matched += c.matched; total.distance += c.distance;
            }
        }
    }
    let mean = |x: &[f64]| x.iter().filter(|v| v.is_finite()).sum::<f64>() / x.len() as f64;
    let mean32 = |x: &[f32]| x.iter().map(|v| f64::from(*v)).sum::<f64>() / x.len() as f64;
    println!("agent_iou observed {:.3} imagined {:.3}   background iou {:.3} {:.3}", mean(&iou[0]), mean(&iou[1]), mean(&bg[0]), mean(&bg[1]));
    for (name, c) in ["observed", "imagined"].iter().zip(counts) {
        println!("objects {name}: recall {:.3} precision {:.3} position {:.2} px", c.matched as f64 / c.truth as f64, c.matched as f64 / c.found.max(1) as f64, c.distance / c.matched.max(1) as f64);
    }
    println!("psnr observed {:.2} imagined {:.2}  gain over copy {:.2} dB  action gain {:.2} dB", mean32(&observed_psnr), mean32(&imagined_psnr), mean32(&gain), mean32(&action_gain));
    Ok(())
}
