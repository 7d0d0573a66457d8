//! Loads a service with robots, and tells what it takes.
//!
//! Two kinds of load. [`capacity`] and [`soak`] are open: frames come at a constant rate whether or not the service keeps
//! up, as cameras send them, and a time is counted from when the frame came ([`open`]), so a stalled service cannot hide
//! the frames that had to wait. [`turns`] is closed: each of so many robots sends when it has its answer; `cargo xtask
//! bench` has services take turns under it. [`robot`] and [`peer`] are the robots, [`record`] what is counted.

#![expect(clippy::print_stdout, reason = "what was measured goes to standard output")]

mod capacity;
mod open;
mod peer;
mod record;
mod robot;
mod soak;
mod turns;

use anyhow::Result;
use clap::Parser;

/// Loads a world-model service with robots that send frames at a constant rate, or as fast as they are answered.
#[derive(Parser)]
#[command(version)]
enum Command {
    /// Find the highest frame rate at which 99 of 100 frames are dealt with before the next one comes
    Capacity(capacity::Arguments),
    /// Keep up a load for minutes, and print times and the server's memory as they go
    Soak(soak::Arguments),
    /// Measure when told to: each line on standard input is answered by a line of numbers
    ///
    /// `observe ROBOTS SECONDS` and `stream ROBOTS SECONDS` (the same over one stream a robot) are answered by
    /// observations a second and their 50th and 99th percentile in milliseconds, `imagine CANDIDATES HORIZON SECONDS` by
    /// steps of rows a second.
    Turns(turns::Arguments),
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<()> {
    match Command::parse() {
        Command::Capacity(arguments) => capacity::run(&arguments).await,
        Command::Soak(arguments) => soak::run(&arguments).await,
        Command::Turns(arguments) => turns::run(&arguments).await,
    }
}
