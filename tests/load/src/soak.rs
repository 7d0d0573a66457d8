//! A load that goes on for minutes: times and the server's memory as they go.

use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use fs_err as fs;

use crate::{
    capacity::open_loop,
    robot::{Futures, Service},
};

/// After so much of the time everything that is made once has been made.
const WARM: f64 = 0.2;

#[derive(Args)]
pub(crate) struct Arguments {
    /// Address of the gRPC API
    #[arg(long, default_value = "http://127.0.0.1:50051")]
    server: String,
    /// Process of the server
    #[arg(long)]
    pid: u32,
    /// Robots
    #[arg(long, default_value_t = 4)]
    robots: u64,
    /// Frames a second of each
    #[arg(long, default_value_t = 10.0)]
    rate: f64,
    /// Candidates that each robot has imagined after each frame
    #[arg(long, default_value_t = 4)]
    candidates: usize,
    /// Steps of each candidate
    #[arg(long, default_value_t = 15)]
    horizon: usize,
    /// How long
    #[arg(long, default_value_t = 10.0)]
    minutes: f64,
    /// Growth of memory after the first fifth of the time, in MB, beyond which this fails
    #[arg(long, default_value_t = 10.0)]
    growth: f64,
}

/// Loads, prints a line every ten seconds, and fails if memory has grown.
pub(crate) async fn run(arguments: &Arguments) -> Result<()> {
    let Arguments { candidates, horizon, .. } = *arguments;
    let futures = (candidates > 0).then_some(Futures { candidates, horizon });
    let mut robots = Vec::new();
    for number in 0..arguments.robots {
        robots.push(Service::connect(&arguments.server).await?.robot(number, true).await?);
    }
    println!(
        "{:>8}{:>8}{:>9}{:>10}{:>12}{:>12}{:>12}",
        "time", "frames", "refused", "unserved", "seen p99", "done p99", "memory"
    );
    let (began, mut used) = (Instant::now(), Vec::new());
    let all = Duration::from_secs_f64(60.0 * arguments.minutes);
    while began.elapsed() < all {
        let outcome;
        let part = Duration::from_secs(10).min(all);
        (robots, outcome) = open_loop(robots, arguments.rate, part, futures).await?;
        let memory = memory(arguments.pid)?;
        used.push((began.elapsed(), memory));
        println!(
            "{:>6} s{:>8}{:>9}{:>10}{:>9.1} ms{:>9.1} ms{:>9.1} MB",
            began.elapsed().as_secs(),
            outcome.frames(),
            outcome.refused,
            outcome.unserved,
            outcome.observed.millis(99.0),
            outcome.done.millis(99.0),
            memory as f64 / 1e6
        );
    }
    let warm = used.iter().filter(|(at, _)| *at > all.mul_f64(WARM)).map(|(_, bytes)| *bytes);
    let first = warm.clone().next().context("too short to tell")?;
    let most = warm.max().unwrap_or(first);
    let growth = most.saturating_sub(first) as f64 / 1e6;
    println!("after the first fifth memory grew by {growth:.1} MB at most");
    ensure!(growth <= arguments.growth, "that is more than {} MB", arguments.growth);
    Ok(())
}

/// Memory of a process that is in use, in bytes.
pub(crate) fn memory(pid: u32) -> Result<u64> {
    let status = fs::read_to_string(format!("/proc/{pid}/status"))?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.trim().strip_suffix(" kB")?.parse::<u64>().ok());
    Ok(1024 * kib.context("a process without VmRSS")?)
}
