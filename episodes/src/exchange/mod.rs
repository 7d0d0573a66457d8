//! Data of the formats that labs use, read and written: LeRobotDataset v3, MCAP, robomimic's HDF5, BAIR's TFRecords.
//!
//! - [`import_lerobot`], [`import_mcap`], [`import_hdf5`], [`import_tfrecord`] make a new data set, whole or not at all;
//!   [`export_lerobot`] and [`export_mcap`] write one for others.
//! - [`McapWriter`] writes one recording, as it happens.
//! - [`ImportOptions`] is what the sources do not say, and how pictures are fitted ([`Fit`](crate::Fit)); an [`Imported`]
//!   says what was left out and why.
//!
//! What importers share is in `import.rs`, pictures are decoded and encoded in `picture.rs`. A failure is an
//! [`Error::Import`](crate::Error::Import): file, row and column, and what is wrong there, an [`ImportProblem`].
//! `docs/formats.md` has the rules of each format for those who use them.

mod hdf5;
mod import;
mod lerobot;
mod mcap;
mod picture;
mod problem;
mod tfrecord;

pub use hdf5::{Hdf5Source, import_hdf5};
pub use import::{ImportOptions, Imported, Skipped};
pub use lerobot::{LerobotSource, export_lerobot, import_lerobot};
pub use mcap::{McapSource, McapWriter, export_mcap, import_mcap};
pub use problem::ImportProblem;
pub use tfrecord::{TfrecordSource, import_tfrecord};
