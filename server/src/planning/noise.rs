//! Random numbers of a search: Philox 4x32-10, a function of the seed and of what they are for.

use std::f64::consts::TAU;

use gatsbi_models::noise::philox4x32_10;

/// Keeps a search's numbers apart from those of rollouts with the same seed.
const SEARCH: u32 = 0x706c_616e;

/// Draws of one search.
#[derive(Clone, Copy, Debug)]
pub struct Draws {
    /// The seed.
    pub seed: u64,
    /// The iteration.
    pub iteration: u32,
}

impl Draws {
    fn bits(self, candidate: u32, dimension: u32, at: u32) -> [u32; 4] {
        let key = [self.seed as u32 ^ SEARCH, (self.seed >> 32) as u32];
        philox4x32_10([at, dimension, candidate, self.iteration], key)
    }

    /// A number in [0, 1).
    pub fn uniform(self, candidate: u32, dimension: u32, at: u32) -> f64 {
        f64::from(self.bits(candidate, dimension, at)[0]) / (f64::from(u32::MAX) + 1.0)
    }

    /// Two independent numbers from N(0, 1).
    fn normals(self, candidate: u32, dimension: u32, at: u32) -> [f64; 2] {
        let [a, b, ..] = self.bits(candidate, dimension, at);
        let above_zero = (f64::from(a) + 1.0) / (f64::from(u32::MAX) + 1.0);
        let radius = (-2.0 * above_zero.ln()).sqrt();
        let angle = TAU * f64::from(b) / (f64::from(u32::MAX) + 1.0);
        [radius * angle.cos(), radius * angle.sin()]
    }

    /// `steps` numbers of unit variance whose power falls as frequency^-beta: 0 is white, 1 pink, 2 brown
    /// (Timmer & Koenig 1995, as in Pinneri et al. 2020, section 3.1). The lowest frequency stands in for zero.
    pub fn coloured(self, candidate: u32, dimension: u32, steps: usize, beta: f64) -> Vec<f64> {
        if beta == 0.0 || steps == 1 {
            return (0..steps as u32).map(|at| self.normals(candidate, dimension, at)[0]).collect();
        }
        let length = steps as f64;
        let highest = steps / 2;
        let even = steps.is_multiple_of(2);
        let amplitude = |k: usize| (k.max(1) as f64 / length).powf(-beta / 2.0);
        // Frequencies that are their own mirror image have a real part only.
        let alone = |k: usize| k == 0 || (even && k == highest);
        let waves: Vec<[f64; 2]> = (0..=highest)
            .map(|k| {
                let [real, imaginary] = self.normals(candidate, dimension, k as u32);
                // A pair of mirrored frequencies carries twice the power of one.
                if alone(k) {
                    [amplitude(k) * real, 0.0]
                } else {
                    [amplitude(k) * real * 2f64.sqrt(), amplitude(k) * imaginary * 2f64.sqrt()]
                }
            })
            .collect();
        let power: f64 =
            (0..=highest).map(|k| if alone(k) { 1.0 } else { 2.0 } * amplitude(k).powi(2)).sum();
        let scale = power.sqrt().recip();
        (0..steps)
            .map(|t| {
                let sum: f64 = waves
                    .iter()
                    .enumerate()
                    .map(|(k, [real, imaginary])| {
                        let angle = TAU * k as f64 * t as f64 / length;
                        real * angle.cos() - imaginary * angle.sin()
                    })
                    .sum();
                sum * scale
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn series(beta: f64, steps: usize) -> Vec<Vec<f64>> {
        let draws = Draws { seed: 7, iteration: 0 };
        (0..4000).map(|candidate| draws.coloured(candidate, 3, steps, beta)).collect()
    }

    fn correlation(series: &[Vec<f64>], lag: usize) -> f64 {
        series.iter().map(|x| x[2] * x[2 + lag]).sum::<f64>() / series.len() as f64
    }

    #[test]
    fn every_colour_has_unit_variance() {
        for (beta, steps) in [(0.0, 15), (1.0, 15), (2.0, 15), (2.0, 16), (3.5, 2), (2.0, 1)] {
            let series = series(beta, steps);
            for t in 0..steps {
                let variance =
                    series.iter().map(|x| x[t] * x[t]).sum::<f64>() / series.len() as f64;
                assert!((variance - 1.0).abs() < 0.1, "beta {beta}, {steps} steps: {variance}");
            }
        }
    }

    #[test]
    fn steeper_spectra_hold_longer() {
        let [white, pink, brown] = [0.0, 1.0, 2.0].map(|beta| correlation(&series(beta, 15), 1));
        assert!(white.abs() < 0.06 && pink > 0.3 && brown > pink + 0.1, "{white} {pink} {brown}");
    }

    #[test]
    fn a_number_depends_on_all_that_names_it() {
        let at = |seed, iteration, candidate, dimension| {
            Draws { seed, iteration }.coloured(candidate, dimension, 4, 2.0)
        };
        let one = at(1, 2, 3, 4);
        assert_eq!(one, at(1, 2, 3, 4));
        for other in [at(2, 2, 3, 4), at(1, 3, 3, 4), at(1, 2, 4, 4), at(1, 2, 3, 5)] {
            assert_ne!(one, other);
        }
    }
}
