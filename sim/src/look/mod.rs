//! Looks at a data set: a sheet of frames and labels for the eye, and statistics that tell whether a scene does what it
//! is meant to. It works on any data set of the format, as far as its columns go.

mod sheet;
mod statistics;

pub use sheet::{SheetOptions, sheet};
pub use statistics::{Spread, Statistics};
