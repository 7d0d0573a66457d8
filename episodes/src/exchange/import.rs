//! What all importers share: their options, their report, and the way from recorded episodes to a data set.

use std::path::{Path, PathBuf};

use crate::{
    ActionDimension, DatasetInfo, Episode, EpisodeData, Fit, Manifest, Provenance, Result,
    WriterOptions, exchange::ImportProblem, schema::column, write_whole,
};

/// What a source does not say about itself, and what is made of its pictures.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ImportOptions {
    /// Name of the data set; by default the source's.
    pub name: Option<String>,
    /// Seconds between two frames; by default what the source says.
    pub frame_period_seconds: Option<f64>,
    /// Names of the action dimensions; by default the source's, or `action_0` and so on.
    pub action_names: Vec<String>,
    /// Their units, or one for all; by default the source's, or `unknown`.
    pub action_units: Vec<String>,
    /// Side of the square frames of the data set; by default frames are taken as they are.
    pub size: Option<u32>,
    /// How frames are brought to that size.
    pub fit: Fit,
    /// Id of the first episode, the others count on from it; by default the source's ids, or 0.
    pub first_id: Option<u64>,
}

/// What an import made.
#[derive(Clone, Debug, PartialEq)]
pub struct Imported {
    /// The data set.
    pub manifest: Manifest,
    /// What the source has and the data set has not.
    pub skipped: Vec<Skipped>,
}

/// Something that was left out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Skipped {
    /// A feature, topic, data set or part of the time.
    pub what: String,
    /// Why.
    pub why: String,
}

/// An episode on its way, and where it is from.
pub(crate) struct Recorded {
    pub(crate) path: PathBuf,
    /// Where in the file: its first row, or its number.
    pub(crate) row: Option<u64>,
    /// Where frames and actions are from in the file.
    pub(crate) frames_from: String,
    pub(crate) actions_from: String,
    pub(crate) data: EpisodeData,
}

impl Skipped {
    pub(crate) fn new(what: impl Into<String>, why: impl Into<String>) -> Self {
        Self { what: what.into(), why: why.into() }
    }
}

impl ImportOptions {
    /// The dimensions of an action: `source` are those the source names, of `dimension` in all.
    pub(crate) fn actions(
        &self,
        source: &[ActionDimension],
        dimension: usize,
    ) -> Result<Vec<ActionDimension>, ImportProblem> {
        let fits = |what, found: usize, one_for_all: bool| {
            if found == 0 || found == dimension || (one_for_all && found == 1) {
                return Ok(());
            }
            let expected = format!("{dimension}, as many as an action has");
            Err(ImportProblem::Layout { what, found: found.to_string(), expected })
        };
        fits("the number of action names", self.action_names.len(), false)?;
        fits("the number of action units", self.action_units.len(), true)?;
        let of_source = |i: usize| source.get(i).filter(|_| source.len() == dimension);
        Ok((0..dimension)
            .map(|i| {
                let name = self.action_names.get(i).cloned();
                let unit = self.action_units.get(i).or_else(|| self.action_units.first()).cloned();
                ActionDimension {
                    name: name
                        .or_else(|| of_source(i).map(|action| action.name.clone()))
                        .unwrap_or_else(|| format!("action_{i}")),
                    unit: unit
                        .or_else(|| of_source(i).map(|action| action.unit.clone()))
                        .unwrap_or_else(|| "unknown".into()),
                }
            })
            .collect())
    }

    /// The description of the new data set.
    pub(crate) fn info(
        &self,
        format: &str,
        path: &Path,
        frame_period: f64,
        actions: Vec<ActionDimension>,
        (width, height): (u32, u32),
    ) -> DatasetInfo {
        let source = path.file_name().map(|name| name.to_string_lossy().into_owned());
        let stem = path.file_stem().map(|name| name.to_string_lossy().into_owned());
        let fitted = self.size.map(|size| {
            ("fitted".to_owned(), format!("{width}x{height} to {size}x{size}, {:?}", self.fit))
        });
        DatasetInfo {
            name: self.name.clone().or(stem).unwrap_or_else(|| "imported".into()),
            height: self.size.unwrap_or(height),
            width: self.size.unwrap_or(width),
            channels: 3,
            frame_period_seconds: self.frame_period_seconds.unwrap_or(frame_period),
            actions,
            labels: None,
            provenance: Some(Provenance {
                generator: format!("imported from {format}"),
                version: None,
                source,
                parameters: fitted.into_iter().map(|(key, value)| (key, value.into())).collect(),
            }),
        }
    }
}

/// Writes data set `dir` from `episodes` that `read` reads one after the other.
pub(crate) fn convert(
    dir: &Path,
    info: DatasetInfo,
    options: WriterOptions,
    episodes: usize,
    progress: &mut dyn FnMut(usize, usize),
    mut read: impl FnMut(usize) -> Result<Recorded>,
) -> Result<Manifest> {
    write_whole(dir, info, options, |writer| {
        for index in 0..episodes {
            let Recorded { path, row, frames_from, actions_from, data } = read(index)?;
            let episode = Episode::new(data, writer.info()).map_err(|source| {
                let column = match source.column() {
                    Some(column::ACTIONS) => &actions_from,
                    _ => &frames_from,
                };
                ImportProblem::from(source).at(&path, row, Some(column))
            })?;
            writer.write(&episode)?;
            progress(index + 1, episodes);
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn actions_are_named_by_the_user_then_the_source_then_their_number() {
        let named =
            |name: &str, unit: &str| ActionDimension { name: name.into(), unit: unit.into() };
        let source = [named("pan", "rad"), named("tilt", "rad")];
        let plain = ImportOptions::default();
        assert_eq!(plain.actions(&source, 2).unwrap(), source);
        let numbered = [named("action_0", "unknown"), named("action_1", "unknown")];
        assert_eq!(plain.actions(&[], 2).unwrap(), numbered);
        let options = ImportOptions {
            action_names: vec!["x".into(), "y".into()],
            action_units: vec!["m".into()],
            ..plain
        };
        assert_eq!(options.actions(&source, 2).unwrap(), [named("x", "m"), named("y", "m")]);
        let error = options.actions(&source, 3).unwrap_err().to_string();
        assert_eq!(error, "the number of action names is 2, expected 3, as many as an action has");
    }
}
