//! Every way that reading or writing episodes can fail, each naming the file and, where there is one, the row and column.
//!
//! [`InvalidEpisode`] says what is wrong with the contents of one episode and knows no file; [`Error`] puts it in its place.
//! Messages state their own part only: print the chain of sources to see the cause.

use std::{io, path::PathBuf};

use parquet::errors::ParquetError;
use zip::result::ZipError;

#[cfg(feature = "exchange")]
use crate::exchange::ImportProblem;
use crate::schema::column;

/// The result of this crate's operations.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// A failed operation on a data set.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The operating system refused; its message names the operation and the path.
    #[error(transparent)]
    Io(#[from] io::Error),

    /// The file has no readable Parquet footer: it is truncated, damaged or something else.
    #[error("{path} is not a complete Parquet file")]
    NotParquet {
        /// The file.
        path: PathBuf,
        /// What the Parquet reader found.
        source: ParquetError,
    },
    /// A sound Parquet file, but not an episode file.
    #[error("{path} is a Parquet file without the metadata key `{key}`: not an episode file")]
    Foreign {
        /// The file.
        path: PathBuf,
        /// The key-value entry that every episode file has.
        key: &'static str,
    },
    /// Written by a later version of the format.
    #[error("{path} has format version {found}; this build reads up to version {supported}")]
    NewerVersion {
        /// The file.
        path: PathBuf,
        /// Version in the file.
        found: u64,
        /// Newest version that can be read.
        supported: u64,
    },
    /// The data-set description or the manifest is not the expected JSON.
    #[error("{path} has a malformed {what}")]
    Metadata {
        /// The file.
        path: PathBuf,
        /// Which text it is.
        what: &'static str,
        /// Where the JSON goes wrong.
        source: serde_json::Error,
    },
    /// The data-set description contradicts itself or exceeds the format.
    #[error("data-set description: `{field}` is {found}, expected {expected}")]
    Description {
        /// Field of [`crate::DatasetInfo`].
        field: &'static str,
        /// Its value.
        found: String,
        /// What it may be.
        expected: &'static str,
    },
    /// A required column is not there.
    #[error("{path} has no column `{column}`")]
    MissingColumn {
        /// The file.
        path: PathBuf,
        /// The column.
        column: &'static str,
    },
    /// A column has another type than the format says.
    #[error("column `{column}` of {path} has type {found}, expected {expected}")]
    ColumnType {
        /// The file.
        path: PathBuf,
        /// The column.
        column: &'static str,
        /// Arrow type in the file.
        found: String,
        /// Arrow type of the format.
        expected: String,
    },
    /// A page of the file cannot be decoded.
    #[error("{path}, row {row}: column `{column}` cannot be decoded")]
    Decode {
        /// The file.
        path: PathBuf,
        /// Row within the file.
        row: usize,
        /// First column that fails.
        column: &'static str,
        /// What the Parquet reader found.
        source: ParquetError,
    },
    /// A row was decoded, but is no valid episode.
    #[error("{path}, row {row}: not a valid episode")]
    Row {
        /// The file.
        path: PathBuf,
        /// Row within the file.
        row: usize,
        /// What is wrong with it.
        source: InvalidEpisode,
    },

    /// A folder of shards has no manifest.
    #[error("{path} is a folder without a {}: not a data set", crate::manifest::FILE_NAME)]
    NoManifest {
        /// The folder.
        path: PathBuf,
    },
    /// The manifest and a shard disagree: the shard was truncated, replaced or edited.
    #[error("{path}: {what} is {found}, but the manifest says {expected}")]
    ShardChanged {
        /// The shard, or the manifest itself where its totals do not add up.
        path: PathBuf,
        /// The disagreeing property.
        what: &'static str,
        /// Its value in the shard.
        found: String,
        /// Its value in the manifest.
        expected: String,
    },
    /// No episode has this index.
    #[error("episode index {index} is out of range: the data set has {len} episodes")]
    OutOfRange {
        /// The index asked for.
        index: usize,
        /// Number of episodes.
        len: usize,
    },
    /// An episode is shorter than the crops asked for.
    #[error("episode {index} has {frames} frames, fewer than the {crop} of a crop")]
    TooShort {
        /// Index of the episode.
        index: usize,
        /// Its length.
        frames: usize,
        /// Length of a crop.
        crop: usize,
    },
    /// A prefetching thread could not be started.
    #[error("a prefetching thread cannot be started")]
    Thread(#[source] io::Error),
    /// A prefetching thread stopped without delivering, which only a panic makes it do.
    #[error("the thread that was to read sample {sample} is gone")]
    Prefetch {
        /// Number of the sample.
        sample: u64,
    },

    /// The folder to be created exists and holds something.
    #[error("{path} exists and is not an empty folder")]
    NotEmpty {
        /// The folder.
        path: PathBuf,
    },
    /// Another writer holds the folder.
    #[error("{path} is being written by another process")]
    Locked {
        /// The folder.
        path: PathBuf,
    },
    /// The episode does not fit the data set.
    #[error("episode {episode_id} cannot be written to {path}")]
    Rejected {
        /// The folder.
        path: PathBuf,
        /// The episode.
        episode_id: u64,
        /// What is wrong with it.
        source: InvalidEpisode,
    },
    /// Episode ids are unique within a data set.
    #[error("{path} already holds an episode {episode_id}")]
    Duplicate {
        /// The folder.
        path: PathBuf,
        /// The id given twice.
        episode_id: u64,
    },
    /// The Parquet writer failed.
    #[error("{path} cannot be written")]
    Write {
        /// The shard.
        path: PathBuf,
        /// What the Parquet writer said.
        source: ParquetError,
    },

    /// The file is no readable ZIP archive, or an entry of it is damaged.
    #[error("{path}: `{array}.npy` cannot be opened in the archive")]
    NpzArchive {
        /// The `.npz` file.
        path: PathBuf,
        /// The array looked for.
        array: &'static str,
        /// What the archive reader found.
        source: ZipError,
    },
    /// The header or the data of an array cannot be read.
    #[error("{path}: array `{array}` cannot be read{}", at_episode(*.episode))]
    NpzRead {
        /// The `.npz` file.
        path: PathBuf,
        /// The array.
        array: &'static str,
        /// The episode being read; `None` in the header.
        episode: Option<usize>,
        /// What went wrong.
        source: io::Error,
    },
    /// An array has another dtype, order or shape than the import expects.
    #[error("{path}: array `{array}` has {what} {found}, expected {expected}")]
    NpzLayout {
        /// The `.npz` file.
        path: PathBuf,
        /// The array.
        array: &'static str,
        /// `dtype`, `order` or `shape`.
        what: &'static str,
        /// As in the file.
        found: String,
        /// As the import needs it.
        expected: String,
    },
    /// The arrays were read, but an episode of them is not valid.
    #[error("{path}, episode {episode}: invalid data in array `{array}`")]
    NpzEpisode {
        /// The `.npz` file.
        path: PathBuf,
        /// The array.
        array: &'static str,
        /// Index along the first axis.
        episode: usize,
        /// What is wrong with it.
        source: InvalidEpisode,
    },

    /// A file of another format cannot be imported.
    #[cfg(feature = "exchange")]
    #[error("{path}{}", at_cell(*.row, .column.as_deref()))]
    Import {
        /// The file.
        path: PathBuf,
        /// Row, record, message or frame in it, counted from 0.
        row: Option<u64>,
        /// Column, feature, topic, key or data set.
        column: Option<String>,
        /// What is wrong there.
        source: ImportProblem,
    },
}

/// What is wrong with the contents of one episode. Columns are named as in the file.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum InvalidEpisode {
    /// An episode has at least one frame.
    #[error("column `length`: the episode has no frames")]
    Empty,
    /// A required value is null.
    #[error("column `{column}` is null")]
    Null {
        /// The column.
        column: &'static str,
    },
    /// A column does not hold one value per frame (and object, pixel, dimension).
    #[error("column `{column}` holds {found} values, expected {expected} = {formula}")]
    Length {
        /// The column.
        column: &'static str,
        /// Values found.
        found: usize,
        /// Values expected.
        expected: usize,
        /// How the expectation is computed, for example `T*A`.
        formula: &'static str,
    },
    /// A column is larger than one Parquet page can hold.
    #[error("column `{column}` would take {bytes} bytes, more than the {limit} of one episode")]
    TooLarge {
        /// The column.
        column: &'static str,
        /// Its size.
        bytes: usize,
        /// The largest size.
        limit: usize,
    },
    /// A number is infinite or not a number where that has no meaning.
    #[error(
        "column `{column}`, frame {frame}, dimension {dimension}: {value} is not a finite number"
    )]
    NonFinite {
        /// The column.
        column: &'static str,
        /// Frame index in the episode.
        frame: usize,
        /// Index within the frame's values.
        dimension: usize,
        /// The value.
        value: f32,
    },
    /// Per-object columns need to know how many objects there are.
    #[error("column `{column}` is given, but `object_count` is null")]
    NoObjectCount {
        /// The column.
        column: &'static str,
    },
    /// More objects than a label map can tell apart.
    #[error("column `object_count`: {found} objects, at most {limit} can be labelled")]
    TooManyObjects {
        /// Objects claimed.
        found: u32,
        /// The most a label map can hold.
        limit: u32,
    },
    /// A label that is neither background, agent nor one of the episode's objects.
    #[error(
        "column `mask`, frame {frame}: label {label} stands for nothing in an episode of {objects} objects"
    )]
    UnknownLabel {
        /// Frame index in the episode.
        frame: usize,
        /// The label.
        label: u8,
        /// Objects in the episode.
        objects: u32,
    },
    /// A contact flag other than 0 and 1.
    #[error("column `{column}`, frame {frame}: contact flag {value}, expected 0 or 1")]
    ContactFlag {
        /// The column.
        column: &'static str,
        /// Frame index in the episode.
        frame: usize,
        /// The value.
        value: u8,
    },
    /// Frames were asked for that the episode does not have.
    #[error("frames {start}..{end} of an episode of {frames} frames")]
    Range {
        /// First frame asked for.
        start: usize,
        /// One past the last.
        end: usize,
        /// Frames there are.
        frames: usize,
    },
}

impl InvalidEpisode {
    /// The column at fault; `None` for a range of frames.
    pub fn column(&self) -> Option<&'static str> {
        match *self {
            Self::Null { column }
            | Self::Length { column, .. }
            | Self::TooLarge { column, .. }
            | Self::NonFinite { column, .. }
            | Self::NoObjectCount { column }
            | Self::ContactFlag { column, .. } => Some(column),
            Self::Empty => Some(column::LENGTH),
            Self::TooManyObjects { .. } => Some(column::OBJECT_COUNT),
            Self::UnknownLabel { .. } => Some(column::MASK),
            Self::Range { .. } => None,
        }
    }
}

fn at_episode(episode: Option<usize>) -> String {
    episode.map_or_else(String::new, |episode| format!(" at episode {episode}"))
}

#[cfg(feature = "exchange")]
fn at_cell(row: Option<u64>, column: Option<&str>) -> String {
    let row = row.map_or_else(String::new, |row| format!(", row {row}"));
    let column = column.map_or_else(String::new, |column| format!(", `{column}`"));
    row + &column
}
