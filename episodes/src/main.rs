//! `gatsbi-episodes`: imports, exports, inspects, splits and joins data sets from the command line.

use std::{
    io::{self, IsTerminal as _, Write as _},
    ops::Range,
    path::{Path, PathBuf},
};

use anyhow::{Context as _, bail, ensure};
use clap::{Args, Parser, Subcommand};
use gatsbi_episodes::{Dataset, DatasetInfo, Manifest, WriterOptions, write_whole};
use indicatif::{ProgressBar, ProgressStyle};

mod report;
mod transfer;

use report::Report;
use transfer::{Export, Import};

/// Robot episodes in Parquet files: import, export, inspect, split, join.
#[derive(Debug, Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Convert data of another format to a new data set.
    #[command(subcommand)]
    Import(Import),
    /// Convert a data set to another format.
    #[command(subcommand)]
    Export(Export),
    /// Print the description, counts, sizes and action statistics of a data set.
    Info(Info),
    /// Copy some episodes of a data set to a new one; ids are kept.
    Split(Split),
    /// Copy data sets of the same shape, one after the other, to a new one; episodes are numbered anew from 0.
    Join(Join),
}

#[derive(Debug, Args)]
struct Info {
    /// Data-set folder or .parquet file.
    path: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
    /// Also read everything: compare checksums and decode every episode.
    #[arg(long)]
    verify: bool,
}

#[derive(Debug, Args)]
struct Split {
    /// Data-set folder or .parquet file.
    path: PathBuf,
    /// Folder to create.
    #[arg(long)]
    out: PathBuf,
    /// Copy the last so many episodes.
    #[arg(long, required_unless_present = "range", conflicts_with = "range")]
    last: Option<usize>,
    /// Copy the episodes at these positions: A..B, A.. or ..B, counted from 0, B excluded.
    #[arg(long)]
    range: Option<String>,
    #[command(flatten)]
    writer: Writer,
}

#[derive(Debug, Args)]
struct Join {
    /// Data-set folders or .parquet files; the new one is described as the first of them.
    #[arg(required = true, num_args = 2..)]
    paths: Vec<PathBuf>,
    /// Folder to create.
    #[arg(long)]
    out: PathBuf,
    #[command(flatten)]
    writer: Writer,
}

#[derive(Debug, Args)]
struct Writer {
    /// Size in MiB at which a shard is closed.
    #[arg(long, default_value_t = 32, value_parser = clap::value_parser!(u16).range(1..=1024))]
    shard_mib: u16,
    /// zstd level.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(i32).range(1..=22))]
    zstd_level: i32,
}

fn main() -> anyhow::Result<()> {
    match Cli::parse().command {
        Command::Import(import) => import.run(),
        Command::Export(export) => export.run(),
        Command::Info(info) => inspect(&info),
        Command::Split(split) => copy(&split),
        Command::Join(parts) => join(&parts),
    }
}

fn inspect(info: &Info) -> anyhow::Result<()> {
    let report = Report::of(&Dataset::open(&info.path)?, info.verify)?;
    if info.json {
        print(&(serde_json::to_string_pretty(&report)? + "\n"))
    } else {
        print(&report.to_string())
    }
}

fn copy(split: &Split) -> anyhow::Result<()> {
    let dataset = Dataset::open(&split.path)?;
    let range = split.positions(dataset.len())?;
    let bar = progress_bar();
    bar.set_length(range.len() as u64);
    let info = dataset.info().clone();
    let manifest = write_whole(&split.out, info, split.writer.options(), |writer| {
        for index in bar.wrap_iter(range) {
            writer.write(&dataset.read(index)?)?;
        }
        Ok(())
    })?;
    bar.finish_and_clear();
    print_written(&split.out, &manifest)
}

fn join(parts: &Join) -> anyhow::Result<()> {
    let open = |path: &PathBuf| Dataset::open(path);
    let datasets = parts.paths.iter().map(open).collect::<Result<Vec<_>, _>>()?;
    let (first, info) = (datasets[0].path(), datasets[0].info());
    for dataset in &datasets {
        let (name, provenance) = (info.name.clone(), info.provenance.clone());
        let renamed = DatasetInfo { name, provenance, ..dataset.info().clone() };
        if let Some((what, found, expected)) = renamed.difference(info) {
            let (path, first) = (dataset.path().display(), first.display());
            bail!("{path}: {what} is {found}, expected {expected} as in {first}");
        }
    }
    let bar = progress_bar();
    bar.set_length(datasets.iter().map(|dataset| dataset.len() as u64).sum());
    let manifest = write_whole(&parts.out, info.clone(), parts.writer.options(), |writer| {
        let every = datasets.iter().flat_map(|each| (0..each.len()).map(move |at| each.read(at)));
        for (id, episode) in (0..).zip(bar.wrap_iter(every)) {
            writer.write(&episode?.numbered(id))?;
        }
        Ok(())
    })?;
    bar.finish_and_clear();
    print_written(&parts.out, &manifest)
}

impl Split {
    fn positions(&self, len: usize) -> anyhow::Result<Range<usize>> {
        let range = match (self.last, &self.range) {
            (Some(last), _) => match len.checked_sub(last) {
                Some(first) => first..len,
                None => bail!("--last {last}: there are only {len} episodes"),
            },
            (None, Some(range)) => {
                parse_range(range, len).with_context(|| format!("--range {range}"))?
            }
            (None, None) => 0..len,
        };
        ensure!(!range.is_empty(), "the split would have no episodes");
        Ok(range)
    }
}

fn parse_range(text: &str, len: usize) -> anyhow::Result<Range<usize>> {
    let (start, end) = text.split_once("..").context("expected A..B, A.. or ..B")?;
    let bound = |text: &str, default| match text {
        "" => Ok(default),
        text => text.parse().with_context(|| format!("`{text}` is not a position")),
    };
    let range = bound(start, 0)?..bound(end, len)?;
    ensure!(range.end <= len, "there are only {len} episodes");
    Ok(range)
}

impl Writer {
    fn options(&self) -> WriterOptions {
        let shard_bytes = usize::from(self.shard_mib) << 20;
        WriterOptions { shard_bytes, zstd_level: self.zstd_level }
    }
}

/// A bar in a terminal, nothing otherwise.
fn progress_bar() -> ProgressBar {
    if !io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} episodes, {eta} left")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::no_length().with_style(style)
}

fn print_written(dir: &Path, manifest: &Manifest) -> anyhow::Result<()> {
    let bytes: u64 = manifest.shards.iter().map(|shard| shard.bytes).sum();
    print(&format!(
        "wrote {}: episodes {}, frames {}, shards {}, {}\n",
        dir.display(),
        manifest.episodes,
        manifest.frames,
        manifest.shards.len(),
        indicatif::DecimalBytes(bytes)
    ))
}

/// Prints to standard output; a reader that has seen enough, such as `head`, is no failure.
fn print(text: &str) -> anyhow::Result<()> {
    match io::stdout().write_all(text.as_bytes()) {
        Err(e) if e.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        written => written.context("standard output"),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn ranges_are_half_open_and_checked() {
        assert_eq!(parse_range("2..5", 10).unwrap(), 2..5);
        assert_eq!(parse_range("..260", 300).unwrap(), 0..260);
        assert_eq!(parse_range("260..", 300).unwrap(), 260..300);
        for wrong in ["5", "a..b", "0..11", "-1..3", "1..2..3"] {
            assert!(parse_range(wrong, 10).is_err(), "{wrong}");
        }
    }

    #[test]
    fn an_empty_split_is_refused() {
        let split = |args: &[&str]| {
            let args = ["gatsbi-episodes", "split", "in", "--out", "out"].iter().chain(args);
            match Cli::try_parse_from(args).unwrap().command {
                Command::Split(split) => split.positions(10),
                other => panic!("{other:?}"),
            }
        };
        assert_eq!(split(&["--last", "4"]).unwrap(), 6..10);
        assert_eq!(split(&["--range", "4.."]).unwrap(), 4..10);
        for wrong in [["--last", "0"], ["--last", "11"], ["--range", "5..5"], ["--range", "6..5"]] {
            assert!(split(&wrong).is_err(), "{wrong:?}");
        }
    }
}
