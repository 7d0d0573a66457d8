//! What a run tells while it runs: a bar in a terminal, a line a minute elsewhere, and event files.

use std::{
    collections::BTreeMap,
    io::IsTerminal as _,
    path::Path,
    time::{Duration, Instant},
};

use indicatif::{ProgressBar, ProgressStyle};

use crate::events::Events;

/// Seconds between lines where there is no terminal.
const LINE_EVERY: Duration = Duration::from_mins(1);

/// Steps between points in the event files.
const POINT_EVERY: u64 = 20;

/// The voice of a run.
#[derive(Debug)]
pub struct Journal {
    bar: Option<ProgressBar>,
    events: Events,
    sums: BTreeMap<&'static str, (f64, f64)>,
    recent: BTreeMap<&'static str, f64>,
    said: Instant,
    steps: u64,
    frames: f64,
    frames_since: Instant,
}

impl Journal {
    /// Starts the journal of a run of `steps` steps of which `done` are done, in `folder`.
    ///
    /// # Errors
    /// Of the file system.
    pub fn start(folder: &Path, done: u64, steps: u64) -> std::io::Result<Self> {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(steps).with_position(done);
            let style = ProgressStyle::with_template("{bar:30} {pos}/{len} {eta} left  {msg}");
            bar.with_style(style.expect("the template is valid"))
        });
        Ok(Self {
            bar,
            events: Events::create(&folder.join("events"))?,
            sums: BTreeMap::new(),
            recent: BTreeMap::new(),
            said: Instant::now(),
            steps,
            frames: 0.0,
            frames_since: Instant::now(),
        })
    }

    /// Tells the numbers of a step that saw `frames` frames.
    ///
    /// # Errors
    /// Of the file system.
    pub fn step(
        &mut self,
        step: u64,
        frames: f64,
        numbers: impl IntoIterator<Item = (&'static str, f64)>,
    ) -> std::io::Result<()> {
        for (name, value) in numbers {
            let entry = self.sums.entry(name).or_insert((0.0, 0.0));
            *entry = (entry.0 + value, entry.1 + 1.0);
        }
        self.frames += frames;
        if step.is_multiple_of(POINT_EVERY) {
            let sums = std::mem::take(&mut self.sums);
            self.recent =
                sums.into_iter().map(|(name, (sum, count))| (name, sum / count)).collect();
            self.events.scalars(step, self.recent.iter().map(|(name, value)| (*name, *value)))?;
        }
        let rate = self.frames / self.frames_since.elapsed().as_secs_f64();
        if let Some(bar) = &self.bar {
            bar.set_position(step);
            bar.set_message(format!("{rate:.0} frames/s  {}", self.numbers()));
        } else if self.said.elapsed() >= LINE_EVERY || step == self.steps {
            self.said = Instant::now();
            self.say(&format!(
                "step {step}/{}  {rate:.0} frames/s  {}",
                self.steps,
                self.numbers()
            ));
            (self.frames, self.frames_since) = (0.0, Instant::now());
        }
        Ok(())
    }

    /// Says something that happens once.
    pub fn say(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.println(line),
            None => eprintln!("{line}"),
        }
    }

    /// The event file, for pictures.
    pub fn events(&mut self) -> &mut Events {
        &mut self.events
    }

    fn numbers(&self) -> String {
        let parts = self.recent.iter().map(|(name, value)| format!("{name} {value:.1}"));
        parts.collect::<Vec<_>>().join("  ")
    }
}
