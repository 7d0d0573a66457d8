//! The highest frame rate that a service keeps up with, for growing numbers of robots.

use std::time::Duration;

use anyhow::Result;
use clap::Args;
use futures_util::future::try_join_all;
use tokio::time::Instant;

use crate::{
    open::Arrivals,
    record::{Outcome, Times},
    robot::{Futures, Robot, Service},
    soak::memory,
};

/// Halvings of the range in which the rate is looked for: it is known to 6 % then.
const HALVINGS: u32 = 5;

#[derive(Args)]
pub(crate) struct Arguments {
    /// Address of the gRPC API
    #[arg(long, default_value = "http://127.0.0.1:50051")]
    server: String,
    /// Process of the server, whose memory is told
    #[arg(long)]
    pid: Option<u32>,
    /// Numbers of robots
    #[arg(long, value_delimiter = ',', default_value = "1,2,4,8,16")]
    robots: Vec<u32>,
    /// Candidates that each robot has imagined after each frame
    #[arg(long, default_value_t = 0)]
    candidates: usize,
    /// Steps of each candidate
    #[arg(long, default_value_t = 15)]
    horizon: usize,
    /// Seconds of each load
    #[arg(long, default_value_t = 8)]
    seconds: u64,
}

/// Looks for the rate of each number of robots, and prints a line for each.
pub(crate) async fn run(arguments: &Arguments) -> Result<()> {
    let Arguments { candidates, horizon, .. } = *arguments;
    let futures = (candidates > 0).then_some(Futures { candidates, horizon });
    let time = Duration::from_secs(arguments.seconds);
    println!("frames a second and robot at which 99 of 100 are done before the next comes");
    println!("each frame is observed, then {candidates} candidates x {horizon} steps imagined");
    println!(
        "{:>6}{:>10}{:>12}{:>12}{:>12}{:>12}{:>10}",
        "robots", "rate", "frames/s", "seen p50", "seen p99", "done p99", "memory"
    );
    for &count in &arguments.robots {
        let mut robots = Vec::new();
        for number in 0..u64::from(count) {
            robots.push(Service::connect(&arguments.server).await?.robot(number, true).await?);
        }
        // As fast as they are answered: an open load cannot be kept up with beyond that.
        let closed;
        (robots, closed) = closed_loop(robots, time, futures).await?;
        let most = 1.1 * closed.count() as f64 / time.as_secs_f64() / f64::from(count);
        let mut best: Option<(f64, Outcome)> = None;
        let (mut low, mut high) = (most / 8.0, most);
        for _ in 0..HALVINGS {
            let rate = (low * high).sqrt();
            let outcome;
            (robots, outcome) = open_loop(robots, rate, time, futures).await?;
            if outcome.keeps(Duration::from_secs_f64(1.0 / rate)) {
                low = rate;
                best = Some((rate, outcome));
            } else {
                high = rate;
            }
        }
        let memory = arguments.pid.map(memory).transpose()?;
        let memory = memory.map_or(String::new(), |bytes| format!("{:.0} MB", bytes as f64 / 1e6));
        match best {
            Some((rate, outcome)) => println!(
                "{count:>6}{rate:>7.2} Hz{:>12.1}{:>9.1} ms{:>9.1} ms{:>9.1} ms{memory:>10}",
                rate * f64::from(count),
                outcome.observed.millis(50.0),
                outcome.observed.millis(99.0),
                outcome.done.millis(99.0),
            ),
            None => println!("{count:>6}  below {low:.2} Hz{memory:>58}"),
        }
        for robot in robots {
            robot.leave().await?;
        }
    }
    Ok(())
}

/// Robots that send the next frame when they have dealt with the one before.
async fn closed_loop(
    robots: Vec<Robot>,
    time: Duration,
    futures: Option<Futures>,
) -> Result<(Vec<Robot>, Times)> {
    let end = Instant::now() + time;
    let all = try_join_all(robots.into_iter().map(async |mut robot| {
        let mut times = Times::default();
        while Instant::now() < end {
            let began = Instant::now();
            robot.deal(futures).await?;
            times.record(began.elapsed());
        }
        Ok::<_, anyhow::Error>((robot, times))
    }));
    let (robots, times): (Vec<_>, Vec<_>) = all.await?.into_iter().unzip();
    let mut all = Times::default();
    times.iter().try_for_each(|times| all.add(times))?;
    Ok((robots, all))
}

/// Robots whose frames come at a constant rate, evenly apart from each other.
pub(crate) async fn open_loop(
    robots: Vec<Robot>,
    rate: f64,
    time: Duration,
    futures: Option<Futures>,
) -> Result<(Vec<Robot>, Outcome)> {
    let period = Duration::from_secs_f64(1.0 / rate);
    let start = Instant::now();
    let count = robots.len() as u32;
    let all = try_join_all(robots.into_iter().enumerate().map(async |(number, mut robot)| {
        let first = start + period * number as u32 / count;
        let arrivals = Arrivals { first, period, end: start + time, grace: period.max(time / 8) };
        let outcome = arrivals.serve(async || robot.deal(futures).await).await?;
        Ok::<_, anyhow::Error>((robot, outcome))
    }));
    let (robots, outcomes): (Vec<_>, Vec<_>) = all.await?.into_iter().unzip();
    let mut all = Outcome::default();
    outcomes.iter().try_for_each(|outcome| all.add(outcome))?;
    Ok((robots, all))
}
