//! Measures how fast a data set is read: whole episodes one after another, and shuffled crops in the background.
//!
//! ```text
//! cargo run --release -p gatsbi-episodes --example read_speed -- DATASET [CROP_FRAMES]
//! ```
#![expect(clippy::print_stdout, reason = "an example that prints its measurements")]

use std::{env, num::NonZeroUsize, sync::Arc, time::Instant};

use anyhow::Context as _;
use gatsbi_episodes::{Dataset, Prefetch, PrefetchOptions};

fn main() -> anyhow::Result<()> {
    let mut args = env::args().skip(1);
    let path = args.next().context("usage: read_speed DATASET [CROP_FRAMES]")?;
    let crop = args.next().map(|crop| crop.parse()).transpose()?.unwrap_or(NonZeroUsize::MIN);

    let start = Instant::now();
    let dataset = Arc::new(Dataset::open(&path)?);
    println!("open        {:>8.2} ms", start.elapsed().as_secs_f64() * 1e3);

    let start = Instant::now();
    let summaries = dataset.summaries()?;
    println!("summaries   {:>8.2} ms", start.elapsed().as_secs_f64() * 1e3);

    let frames: usize = summaries.iter().map(|episode| episode.length).sum();
    let report = |what: &str, frames: usize, episodes: usize, start: Instant| {
        let seconds = start.elapsed().as_secs_f64();
        let (rate, each) = (frames as f64 / seconds, seconds * 1e3 / episodes as f64);
        println!("{what:<20} {rate:>9.0} frames/s {each:>8.3} ms/episode");
    };
    let start = Instant::now();
    for episode in dataset.iter() {
        episode?;
    }
    report("episodes in order", frames, dataset.len(), start);

    for threads in [1, 2] {
        let threads = NonZeroUsize::new(threads).context("at least one thread")?;
        for (what, crop) in [("episodes", None), ("crops", Some(crop))] {
            let options =
                PrefetchOptions { crop, threads, epochs: Some(3), ..PrefetchOptions::default() };
            let (start, mut seen) = (Instant::now(), 0);
            for clip in Prefetch::start(&dataset, options)? {
                seen += clip?.frames().length();
            }
            let what = format!("{what}, {threads} threads");
            report(&what, seen, dataset.len() * 3, start);
        }
    }
    Ok(())
}
