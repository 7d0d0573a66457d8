//! `meta/stats.json`: what LeRobot normalises its inputs with.

use serde_json::{Value, json};

/// Least, greatest, mean and deviation of each dimension of a feature.
#[derive(Clone, Debug, Default)]
pub(super) struct Statistics {
    count: u64,
    least: Vec<f64>,
    greatest: Vec<f64>,
    sum: Vec<f64>,
    squares: Vec<f64>,
}

impl Statistics {
    /// Adds values, `dimension` of them at a time.
    pub(super) fn add(&mut self, values: impl IntoIterator<Item = f64>, dimension: usize) {
        self.least.resize(dimension, f64::INFINITY);
        self.greatest.resize(dimension, f64::NEG_INFINITY);
        self.sum.resize(dimension, 0.0);
        self.squares.resize(dimension, 0.0);
        for (i, value) in values.into_iter().enumerate() {
            let at = i % dimension;
            self.least[at] = self.least[at].min(value);
            self.greatest[at] = self.greatest[at].max(value);
            self.sum[at] += value;
            self.squares[at] += value * value;
            self.count += u64::from(at == 0);
        }
    }

    /// As LeRobot writes it. Of pictures each number stands in a channel of `[3,1,1]`, and samples are frames.
    pub(super) fn json(&self, picture: Option<u64>) -> Value {
        let count = self.count.max(1) as f64;
        let mean: Vec<f64> = self.sum.iter().map(|sum| sum / count).collect();
        let deviation: Vec<f64> = self
            .squares
            .iter()
            .zip(&mean)
            .map(|(squares, mean)| (squares / count - mean * mean).max(0.0).sqrt())
            .collect();
        let shaped = |values: &[f64]| match picture {
            Some(_) => values.iter().map(|value| json!([[value]])).collect(),
            None => json!(values),
        };
        json!({
            "min": shaped(&self.least),
            "max": shaped(&self.greatest),
            "mean": shaped(&mean),
            "std": shaped(&deviation),
            "count": [picture.unwrap_or(self.count)],
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dimensions_are_kept_apart() {
        let mut statistics = Statistics::default();
        statistics.add([1.0, 10.0, 3.0, 10.0], 2);
        let expected = json!({
            "min": [1.0, 10.0], "max": [3.0, 10.0], "mean": [2.0, 10.0], "std": [1.0, 0.0], "count": [2],
        });
        assert_eq!(statistics.json(None), expected);
        assert_eq!(statistics.json(Some(7))["mean"], json!([[[2.0]], [[10.0]]]));
    }
}
