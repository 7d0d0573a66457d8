//! The distributions of the model and their divergences. Nothing is drawn here: noise is an argument.

use tch::Tensor;

/// Added after the softplus of every scale, so that no distribution degenerates.
const SCALE_FLOOR: f64 = 1e-4;

/// Smallest distance of a probability to 0 and 1, the spacing of f32 at 1.
const PROBABILITY_MARGIN: f64 = 1.192_092_9e-7;

/// Logarithm of the square root of 2 pi.
const HALF_LOG_TAU: f64 = 0.918_938_533_204_672_7;

/// `softplus(x) + 1e-4`, the map from raw numbers to standard deviations.
pub(crate) fn positive(raw: &Tensor) -> Tensor {
    raw.softplus() + SCALE_FLOOR
}

/// A diagonal normal distribution.
#[derive(Debug)]
pub struct Normal {
    /// Mean.
    pub loc: Tensor,
    /// Standard deviation, positive, of the shape of `loc`.
    pub scale: Tensor,
}

impl Normal {
    /// From `[..., 2 d]` network outputs: first half mean, second half raw scale.
    pub(crate) fn from_head(outputs: &Tensor) -> Self {
        let half = outputs.size()[outputs.dim() - 1] / 2;
        Self::from_parts(&outputs.narrow(-1, 0, half), &outputs.narrow(-1, half, half))
    }

    /// From a mean and a raw scale of equal shapes.
    pub(crate) fn from_parts(loc: &Tensor, raw_scale: &Tensor) -> Self {
        Self { loc: loc.shallow_clone(), scale: positive(raw_scale) }
    }

    /// The same distribution with standard deviations of at most `ceiling`.
    #[must_use]
    pub(crate) fn clamp_scale(self, ceiling: f64) -> Self {
        Self { scale: self.scale.clamp_max(ceiling), ..self }
    }

    /// `loc + scale * noise`.
    pub fn sample(&self, noise: &Tensor) -> Tensor {
        &self.loc + &self.scale * noise
    }

    /// KL(self || other) per element (object spec 3.9).
    pub fn kl(&self, other: &Self) -> Tensor {
        kl_from(&(&self.scale / &other.scale), &((&self.loc - &other.loc) / &other.scale))
    }

    /// KL(self || N(loc, scale)) per element, for a prior that is the same everywhere.
    pub fn kl_to(&self, loc: &Tensor, scale: &Tensor) -> Tensor {
        kl_from(&(&self.scale / scale), &((&self.loc - loc) / scale))
    }

    /// KL(self || N(0, 1)) per element.
    pub fn kl_to_standard(&self) -> Tensor {
        kl_from(&self.scale, &self.loc)
    }
}

/// `1/2 (ratio² + shift² - 1 - log ratio²)`.
fn kl_from(ratio: &Tensor, shift: &Tensor) -> Tensor {
    let variance = ratio.square();
    (&variance + shift.square() - 1.0 - variance.log()) * 0.5
}

/// A sample of the relaxed Bernoulli distribution with probability `p`, in (0, 1) (object spec 3.9).
///
/// `uniform` 1/2 at temperature 1 gives `p` itself.
pub(crate) fn relaxed_bernoulli(p: &Tensor, uniform: &Tensor, temperature: f64) -> Tensor {
    let logit = |x: &Tensor| {
        let x = x.clamp(PROBABILITY_MARGIN, 1.0 - PROBABILITY_MARGIN);
        x.log() - (-&x).log1p()
    };
    ((logit(uniform) + logit(p)) / temperature).sigmoid().clamp(1.2e-38, 1.0 - PROBABILITY_MARGIN)
}

/// KL(Bernoulli(p) || Bernoulli(q)) per element with the stated epsilons (object spec 3.9): in f32 the prior's
/// 1 - q rounds to 1 and a certain object costs about 23 nats.
pub(crate) fn kl_bernoulli(p: &Tensor, q: f64) -> Tensor {
    const EPS: f64 = 1e-15;
    // Materialised in f32, as the recorded numbers are.
    let q = f64::from(q as f32);
    let not_q = f64::from(1.0f32 - q as f32);
    let not_p: Tensor = 1.0 - p;
    let ratio = (p + EPS).log() - (q + EPS).ln();
    let not_ratio = (&not_p + EPS).log() - (not_q + EPS).ln();
    p * ratio + not_p * not_ratio
}

/// log N(x | mean, std²) per element.
pub(crate) fn normal_log_density(x: &Tensor, mean: &Tensor, std: f64) -> Tensor {
    ((x - mean) / std).square() * -0.5 - (std.ln() + HALF_LOG_TAU)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uniform_half_gives_the_probability() {
        let p = Tensor::from_slice(&[0.001f32, 0.2, 0.5, 0.93, 0.9999]);
        let sample = relaxed_bernoulli(&p, &p.full_like(0.5), 1.0);
        assert!((sample - p).abs().max().double_value(&[]) < 1e-6);
    }

    #[test]
    fn kl_of_equal_distributions_is_zero_and_the_forms_agree() {
        let loc = Tensor::from_slice(&[0.3f32, -2.0]);
        let scale = Tensor::from_slice(&[0.5f32, 3.0]);
        let q = Normal { loc: loc.copy(), scale: scale.copy() };
        assert!(q.kl(&q).abs().max().double_value(&[]) < 1e-6);
        let standard = q.kl_to(&loc.zeros_like(), &scale.ones_like());
        assert!((standard - q.kl_to_standard()).abs().max().double_value(&[]) < 1e-6);
    }
}
