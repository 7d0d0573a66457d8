//! How far a long command is: a bar in a terminal, a line every few seconds otherwise.

use std::{
    io::{self, IsTerminal as _},
    time::{Duration, Instant},
};

use indicatif::{HumanDuration, ProgressBar, ProgressStyle};

/// Between two lines where there is no terminal.
const INTERVAL: Duration = Duration::from_secs(10);

/// The progress of one command.
pub(crate) struct Progress {
    bar: ProgressBar,
    in_terminal: bool,
    began: Instant,
    shown: Instant,
    /// Done before the command began.
    before: Option<u64>,
}

impl Progress {
    pub(crate) fn new() -> Self {
        let in_terminal = io::stderr().is_terminal();
        let style =
            ProgressStyle::with_template("{bar:40} {pos}/{len} episodes, {per_sec}, {eta} left");
        let bar = if in_terminal { ProgressBar::no_length() } else { ProgressBar::hidden() };
        let now = Instant::now();
        Self {
            bar: bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar())),
            in_terminal,
            began: now,
            shown: now,
            before: None,
        }
    }

    /// Tells that `done` of `all` episodes are done.
    pub(crate) fn show(&mut self, done: u64, all: u64) {
        let before = *self.before.get_or_insert_with(|| {
            // What was there before says nothing about the rate.
            self.bar.reset_eta();
            done
        });
        self.bar.set_length(all);
        self.bar.set_position(done);
        if self.in_terminal || self.shown.elapsed() < INTERVAL {
            return;
        }
        self.shown = Instant::now();
        let rate = (done - before) as f64 / self.began.elapsed().as_secs_f64();
        let left = Duration::from_secs_f64((all - done) as f64 / rate.max(1e-9));
        eprintln!("{done}/{all} episodes, {rate:.2} a second, {} left", HumanDuration(left));
    }

    pub(crate) fn finish(self) {
        self.bar.finish_and_clear();
    }
}
