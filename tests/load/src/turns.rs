//! Closed loads in turns, for `cargo xtask bench`.

use std::{
    io::{BufRead as _, Write as _, stdin, stdout},
    time::Duration,
};

use anyhow::{Context as _, Result, bail};
use clap::Args;
use futures_util::future::try_join_all;
use tokio::time::Instant;

use crate::{
    peer::{Peer, PeerKind},
    record::Times,
    robot::{Futures, Robot, Service},
};

#[derive(Args)]
pub(crate) struct Arguments {
    /// Which other server it is
    #[arg(long, value_enum)]
    peer: Option<PeerKind>,
    /// Where: the gRPC API's address, or a peer's
    #[arg(long)]
    server: String,
    /// Numbers of an action that a peer takes
    #[arg(long, default_value_t = 7)]
    actions: usize,
}

/// Whoever observes.
enum Observer {
    Robot(Box<Robot>),
    Peer(Peer),
}

impl Arguments {
    async fn observer(&self, number: u64, stream: bool) -> Result<Observer> {
        if let Some(kind) = self.peer {
            return Ok(Observer::Peer(Peer::new(kind, &self.server, number, self.actions)));
        }
        let service = Service::connect(&self.server).await?;
        Ok(Observer::Robot(Box::new(service.robot(number, stream).await?)))
    }
}

impl Observer {
    async fn observe(&mut self) -> Result<()> {
        match self {
            Self::Robot(robot) => Ok(robot.observe().await?),
            Self::Peer(peer) => peer.observe().await,
        }
    }

    async fn leave(self) -> Result<()> {
        match self {
            Self::Robot(robot) => robot.leave().await,
            Self::Peer(peer) => peer.leave().await,
        }
    }
}

/// Answers the lines of standard input.
pub(crate) async fn run(arguments: &Arguments) -> Result<()> {
    for line in stdin().lock().lines() {
        let line = line?;
        let words: Vec<&str> = line.split(' ').collect();
        let number = |at: usize| words[at].parse::<f64>().context("not a number");
        let answer = match words[..] {
            ["observe" | "stream", _, _] => {
                let (robots, time) = (number(1)? as u64, Duration::from_secs_f64(number(2)?));
                let (times, took) = observe(arguments, robots, words[0] == "stream", time).await?;
                let rate = times.count() as f64 / took.as_secs_f64();
                format!("{rate} {} {}", times.millis(50.0), times.millis(99.0))
            }
            ["imagine", _, _, _] => {
                let (candidates, horizon) = (number(1)? as usize, number(2)? as usize);
                let time = Duration::from_secs_f64(number(3)?);
                imagine(arguments, Futures { candidates, horizon }, time).await?.to_string()
            }
            _ => bail!("{line:?} is nothing to measure"),
        };
        println!("{answer}");
        stdout().flush()?;
    }
    Ok(())
}

/// Times of observations by so many at once, and how long it took altogether.
async fn observe(
    arguments: &Arguments,
    robots: u64,
    stream: bool,
    time: Duration,
) -> Result<(Times, Duration)> {
    let mut observers = Vec::new();
    for number in 0..robots {
        let mut observer = arguments.observer(number, stream).await?;
        observer.observe().await?;
        observers.push(observer);
    }
    let began = Instant::now();
    let all = try_join_all(observers.into_iter().map(async |mut observer| {
        let mut times = Times::default();
        while times.count() == 0 || began.elapsed() < time {
            let began = Instant::now();
            observer.observe().await?;
            times.record(began.elapsed());
        }
        let ended = Instant::now();
        observer.leave().await?;
        Ok::<_, anyhow::Error>((times, ended))
    }));
    let (mut all_times, mut last) = (Times::default(), began);
    for (times, ended) in all.await? {
        all_times.add(&times)?;
        last = last.max(ended);
    }
    Ok((all_times, last - began))
}

/// Steps of rows a second of one rollout after the other.
async fn imagine(arguments: &Arguments, futures: Futures, time: Duration) -> Result<f64> {
    let Observer::Robot(mut robot) = arguments.observer(0, false).await? else {
        bail!("only gatsbi imagines")
    };
    robot.observe().await?;
    let (began, mut made) = (Instant::now(), 0);
    while made == 0 || began.elapsed() < time {
        robot.imagine(futures).await?;
        made += 1;
    }
    let rows = made * futures.candidates * futures.horizon;
    let rate = rows as f64 / began.elapsed().as_secs_f64();
    robot.leave().await?;
    Ok(rate)
}
