//! Action statistics of a data set: what a model needs to scale raw commands to its network, and a reader to judge the data.

use serde::Serialize;

use crate::{Dataset, InvalidEpisode, Result, schema::column};

/// Range and spread of one action dimension over all steps of all episodes, in its physical unit.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ActionStatistics {
    /// Name of the dimension.
    pub name: String,
    /// Its unit.
    pub unit: String,
    /// Smallest value.
    pub min: f32,
    /// Largest value.
    pub max: f32,
    /// Mean.
    pub mean: f64,
    /// Standard deviation of the population.
    pub std: f64,
}

impl Dataset {
    /// Statistics of each action dimension, without decoding pixels. Empty for a data set without episodes.
    ///
    /// # Errors
    /// [`crate::Error::Decode`] or [`crate::Error::Row`] for damaged or invalid actions.
    pub fn action_statistics(&self) -> Result<Vec<ActionStatistics>> {
        let dimensions = &self.info().actions;
        let mut running = vec![Running::default(); dimensions.len()];
        self.scan(&[column::ACTIONS], |cells, row| {
            let null = || InvalidEpisode::Null { column: column::ACTIONS };
            let actions = cells.floats(column::ACTIONS, row)?.ok_or_else(null)?;
            for (frame, action) in actions.chunks(dimensions.len().max(1)).enumerate() {
                for (dimension, (&value, running)) in action.iter().zip(&mut running).enumerate() {
                    if !value.is_finite() {
                        let column = column::ACTIONS;
                        return Err(InvalidEpisode::NonFinite { column, frame, dimension, value });
                    }
                    running.push(value);
                }
            }
            Ok(())
        })?;
        let statistics = dimensions.iter().zip(running).filter(|(_, running)| running.count > 0.0);
        Ok(statistics
            .map(|(dimension, running)| ActionStatistics {
                name: dimension.name.clone(),
                unit: dimension.unit.clone(),
                min: running.min,
                max: running.max,
                mean: running.mean,
                std: (running.squares / running.count).sqrt(),
            })
            .collect())
    }
}

/// Welford's running mean and sum of squared deviations, which do not cancel as plain sums do.
#[derive(Clone, Debug)]
struct Running {
    count: f64,
    mean: f64,
    squares: f64,
    min: f32,
    max: f32,
}

impl Default for Running {
    fn default() -> Self {
        Self { count: 0.0, mean: 0.0, squares: 0.0, min: f32::INFINITY, max: f32::NEG_INFINITY }
    }
}

impl Running {
    fn push(&mut self, value: f32) {
        let (value, before) = (f64::from(value), self.mean);
        self.count += 1.0;
        self.mean += (value - before) / self.count;
        self.squares += (value - before) * (value - self.mean);
        self.min = self.min.min(value as f32);
        self.max = self.max.max(value as f32);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        DatasetWriter, Episode, WriterOptions,
        testing::{data, info},
    };

    #[test]
    fn statistics_are_those_of_all_steps() {
        let dir = tempfile::tempdir().unwrap();
        let mut writer =
            DatasetWriter::create(dir.path(), info(), WriterOptions::default()).unwrap();
        let steps = [[1.0, 1000.0], [2.0, 1000.5], [6.0, 1001.0]];
        for (id, chunk) in steps.chunks(2).enumerate() {
            let mut data = data(id as u64, chunk.len() as u32, 1);
            data.actions = chunk.as_flattened().to_vec();
            writer.write(&Episode::new(data, &info()).unwrap()).unwrap();
        }
        writer.finish().unwrap();
        let found = Dataset::open(dir.path()).unwrap().action_statistics().unwrap();
        let [x, y] = &found[..] else { panic!("{found:?}") };
        assert_eq!((x.name.as_str(), x.min, x.max, x.mean), ("x", 1.0, 6.0, 3.0));
        assert!((x.std - (14.0_f64 / 3.0).sqrt()).abs() < 1e-12, "{x:?}");
        assert_eq!((y.min, y.max), (1000.0, 1001.0));
        assert!((y.std - (1.0_f64 / 6.0).sqrt()).abs() < 1e-9, "{y:?}");
    }

    #[test]
    fn no_episodes_have_no_statistics() {
        let dir = tempfile::tempdir().unwrap();
        DatasetWriter::create(dir.path(), info(), WriterOptions::default()).unwrap();
        assert_eq!(Dataset::open(dir.path()).unwrap().action_statistics().unwrap(), []);
    }
}
