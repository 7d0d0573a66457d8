//! Means over episodes with their 95 % intervals.

use serde::Serialize;

/// A mean over episodes and half the width of its 95 % interval.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Estimate {
    /// Mean.
    pub mean: f64,
    /// 1.96 standard errors.
    pub ci95: f64,
}

/// Numbers that belong to episodes.
#[derive(Clone, Debug, Default)]
pub struct PerEpisode {
    sums: Vec<(f64, f64)>,
}

impl PerEpisode {
    /// Adds a number of an episode; NaN (nothing to measure) is left out.
    pub fn add(&mut self, episode: usize, value: f64) {
        self.add_weighted(episode, value, 1.0);
    }

    /// Adds a ratio's numerator and denominator; episodes then weigh by their denominators.
    pub fn add_ratio(&mut self, episode: usize, numerator: f64, denominator: f64) {
        self.grow(episode);
        self.sums[episode].0 += numerator;
        self.sums[episode].1 += denominator;
    }

    fn add_weighted(&mut self, episode: usize, value: f64, weight: f64) {
        if value.is_finite() {
            self.add_ratio(episode, value * weight, weight);
        }
    }

    fn grow(&mut self, episode: usize) {
        if self.sums.len() <= episode {
            self.sums.resize(episode + 1, (0.0, 0.0));
        }
    }

    /// Mean over episodes of each episode's own mean.
    pub fn estimate(&self) -> Estimate {
        let means: Vec<f64> =
            self.sums.iter().filter(|(_, n)| *n > 0.0).map(|(sum, n)| sum / n).collect();
        let count = means.len() as f64;
        if means.is_empty() {
            return Estimate { mean: f64::NAN, ci95: f64::NAN };
        }
        let mean = means.iter().sum::<f64>() / count;
        Estimate { mean, ci95: half_width(means.iter().map(|x| x - mean), count) }
    }

    /// Sum of numerators over sum of denominators, with the interval of the ratio over episodes.
    pub fn pooled(&self) -> Estimate {
        let (numerator, denominator) =
            self.sums.iter().fold((0.0, 0.0), |(a, b), (x, y)| (a + x, b + y));
        let mean = numerator / denominator;
        let count = self.sums.iter().filter(|(_, n)| *n > 0.0).count() as f64;
        let each = denominator / count;
        let residuals = self.sums.iter().filter(|(_, n)| *n > 0.0);
        let residuals = residuals.map(|(x, y)| (x - mean * y) / each);
        Estimate { mean, ci95: half_width(residuals, count) }
    }
}

/// 1.96 standard errors of the mean of `count` values whose mean is 0.
fn half_width(values: impl Iterator<Item = f64>, count: f64) -> f64 {
    let squares: f64 = values.map(|x| x * x).sum();
    if count < 2.0 { f64::NAN } else { 1.96 * (squares / (count - 1.0) / count).sqrt() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn episodes_weigh_alike_in_estimates_and_by_size_when_pooled() {
        let mut numbers = PerEpisode::default();
        for value in [1.0, 1.0, 1.0] {
            numbers.add(0, value);
        }
        numbers.add(1, 3.0);
        numbers.add(1, f64::NAN);
        let estimate = numbers.estimate();
        assert!((estimate.mean - 2.0).abs() < 1e-12);
        // Standard deviation sqrt(2), two episodes.
        assert!((estimate.ci95 - 1.96).abs() < 1e-12);
        assert!((numbers.pooled().mean - 1.5).abs() < 1e-12);
    }
}
