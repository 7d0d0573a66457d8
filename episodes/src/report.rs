//! What `gatsbi-episodes info` says about a data set, as text or as JSON.

use std::{
    collections::BTreeMap,
    fmt::{self, Display, Formatter},
    path::PathBuf,
};

use gatsbi_episodes::{ActionStatistics, Dataset, DatasetInfo, Result, schema};
use indicatif::DecimalBytes;
use serde::Serialize;

/// Facts about a data set. Gathering them decodes no pixels.
#[derive(Debug, Serialize)]
pub(crate) struct Report {
    path: PathBuf,
    format: &'static str,
    format_version: u64,
    action_convention: &'static str,
    dataset: DatasetInfo,
    episodes: usize,
    frames: usize,
    seconds: f64,
    shortest: Option<usize>,
    longest: Option<usize>,
    first_id: Option<u64>,
    last_id: Option<u64>,
    /// How many episodes have so many objects.
    object_counts: BTreeMap<u32, usize>,
    shards: usize,
    column_bytes: BTreeMap<&'static str, u64>,
    actions: Vec<ActionStatistics>,
    /// What was compared, if it was asked for.
    verified: Option<&'static str>,
}

impl Report {
    /// Gathers the facts, after reading everything if `verify` says so.
    pub(crate) fn of(dataset: &Dataset, verify: bool) -> Result<Self> {
        if verify {
            dataset.verify()?;
        }
        let checked = match dataset.manifest() {
            Some(_) => "every episode decodes, checksums are those of the manifest",
            None => "every episode decodes",
        };
        let episodes = dataset.summaries()?;
        let frames: usize = episodes.iter().map(|episode| episode.length).sum();
        let mut object_counts = BTreeMap::new();
        for count in episodes.iter().filter_map(|episode| episode.object_count) {
            *object_counts.entry(count).or_default() += 1;
        }
        Ok(Self {
            path: dataset.path().to_path_buf(),
            format: schema::FORMAT,
            format_version: schema::FORMAT_VERSION,
            action_convention: schema::ACTION_CONVENTION,
            dataset: dataset.info().clone(),
            episodes: episodes.len(),
            frames,
            seconds: frames as f64 * dataset.info().frame_period_seconds,
            shortest: episodes.iter().map(|episode| episode.length).min(),
            longest: episodes.iter().map(|episode| episode.length).max(),
            first_id: episodes.first().map(|episode| episode.id),
            last_id: episodes.last().map(|episode| episode.id),
            object_counts,
            shards: dataset.manifest().map_or(1, |manifest| manifest.shards.len()),
            column_bytes: dataset.column_bytes().into_iter().collect(),
            actions: dataset.action_statistics()?,
            verified: verify.then_some(checked),
        })
    }
}

impl Display for Report {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let info = &self.dataset;
        let bytes = self.column_bytes.values().sum();
        let raw = (self.frames * info.frame_bytes()) as u64;
        writeln!(f, "{} ({})", info.name, self.path.display())?;
        writeln!(f, "  format     {} version {}", self.format, self.format_version)?;
        writeln!(
            f,
            "  frames     {}x{}, {} channels, every {} s",
            info.width, info.height, info.channels, info.frame_period_seconds
        )?;
        write!(f, "  episodes   {}, {} frames, {:.0} s", self.episodes, self.frames, self.seconds)?;
        if let (Some(shortest), Some(longest)) = (self.shortest, self.longest) {
            write!(f, ", {shortest} to {longest} frames each")?;
        }
        if let (Some(first), Some(last)) = (self.first_id, self.last_id) {
            write!(f, ", ids {first} to {last}")?;
        }
        writeln!(f)?;
        if !self.object_counts.is_empty() {
            let counts = self.object_counts.iter();
            let counts: Vec<_> = counts.map(|(n, e)| format!("{n} in {e} episodes")).collect();
            writeln!(f, "  objects    {}", counts.join(", "))?;
        }
        if let Some(labels) = info.labels {
            writeln!(
                f,
                "  labels     {} background, {} agent, {}.. objects",
                labels.background, labels.agent, labels.first_object
            )?;
        }
        if let Some(provenance) = &info.provenance {
            write!(f, "  made by    {}", provenance.generator)?;
            for more in [&provenance.version, &provenance.source].into_iter().flatten() {
                write!(f, ", {more}")?;
            }
            writeln!(f)?;
        }
        writeln!(
            f,
            "  files      {}, {}; frames raw {}",
            self.shards,
            DecimalBytes(bytes),
            DecimalBytes(raw)
        )?;
        for (column, bytes) in &self.column_bytes {
            writeln!(f, "    {column:<18} {}", DecimalBytes(*bytes))?;
        }
        writeln!(f, "  actions    {}", self.action_convention)?;
        for action in &self.actions {
            let ActionStatistics { name, unit, min, max, mean, std } = action;
            writeln!(
                f,
                "    {name:<18} {unit:<6} min {min:>9.4}  max {max:>9.4}  mean {mean:>9.4}  std {std:>9.4}"
            )?;
        }
        if let Some(verified) = self.verified {
            writeln!(f, "  verified   {verified}")?;
        }
        Ok(())
    }
}
