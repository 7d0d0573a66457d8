//! Episodes of a robot on the disk: camera frames, actions and, where a simulator knows them, the truth about the scene.
//!
//! A data set is a folder of Parquet files with a manifest, or a single one of these files; one row is one episode. It opens in
//! pandas, Polars and `DuckDB`; this crate is for everything that writes it or trains on it. It knows no torch and no tokio.
//!
//! Where to start:
//! - [`schema`]: the format, column by column, and [`DatasetInfo`], the description that every file carries.
//! - [`Episode`]: one episode in memory, checked once. [`Clip`]: some of its frames with the actions that led to them.
//! - [`DatasetWriter`]: writes a folder that is whole at every moment and can be appended to; [`write_whole`]: all or nothing.
//! - [`Dataset`]: opens, lists and reads; [`Prefetch`]: reads ahead for training in an order that a seed decides.
//! - [`import_npz()`]: converts numpy archives; [`exchange`]: LeRobot, MCAP, HDF5, TFRecords. [`Fit`]: pictures of other sizes. The program `gatsbi-episodes` imports, inspects and splits data sets.
//! - [`Error`]: every failure, with file, row and column.
//!
//! ```
//! use gatsbi_episodes::{ActionDimension, Dataset, DatasetInfo, DatasetWriter, Episode, EpisodeData, WriterOptions};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let info = DatasetInfo {
//!     name: "demo".into(),
//!     height: 2,
//!     width: 2,
//!     channels: 3,
//!     frame_period_seconds: 0.2,
//!     actions: vec![ActionDimension { name: "slide".into(), unit: "m/s".into() }],
//!     labels: None,
//!     provenance: None,
//! };
//! let episode = EpisodeData {
//!     episode_id: 17,
//!     length: 3,
//!     rgb: vec![128; 3 * info.frame_bytes()],
//!     actions: vec![0.1, 0.2, 0.3],
//!     ..EpisodeData::default()
//! };
//! let dir = tempfile::tempdir()?;
//! let mut writer = DatasetWriter::create(dir.path(), info.clone(), WriterOptions::default())?;
//! writer.write(&Episode::new(episode, &info)?)?;
//! writer.finish()?;
//!
//! let dataset = Dataset::open(dir.path())?;
//! assert_eq!(dataset.summaries()?[0].length, 3);
//! assert_eq!(dataset.read(0)?.action(1), [0.2]);
//! # Ok(())
//! # }
//! ```

#[cfg(feature = "exchange")]
pub mod exchange;
pub mod schema;

mod clip;
mod episode;
mod error;
mod fit;
mod import_npz;
mod manifest;
mod pending;
mod prefetch;
mod reader;
mod shard;
mod statistics;
mod table;
#[cfg(test)]
mod testing;
mod writer;

pub use clip::Clip;
pub use episode::{Episode, EpisodeData};
pub use error::{Error, InvalidEpisode, Result};
pub use fit::Fit;
pub use import_npz::{NpzImport, import_npz};
pub use manifest::{Manifest, ShardEntry};
pub use prefetch::{Prefetch, PrefetchOptions};
pub use reader::{Dataset, EpisodeSummary};
pub use schema::{ActionDimension, DatasetInfo, LabelLegend, Provenance};
pub use statistics::ActionStatistics;
pub use writer::{DatasetWriter, WriterOptions, write_whole};
