//! Likelihoods and penalties of the objective, each with its gradient (mixture spec 5, object spec 3.8 and
//! 6.6). Weights, schedules and the sum over time belong to training.

use tch::{Kind, Tensor};

use super::mixture::MixtureStep;
use crate::nn::{Normal, distributions::normal_log_density};

/// Keeps logarithms of alpha and its complement finite.
const EPS: f64 = 1e-5;

/// log N(frame | mean, sigma²) summed over pixels and channels, `[B]`.
pub fn gaussian_log_likelihood(frame: &Tensor, mean: &Tensor, sigma: f64) -> Tensor {
    sum(&normal_log_density(frame, mean, sigma))
}

/// log Σ_k π_k N(frame | o_k, sigma²) per pixel and channel, summed, `[B]`: every slot explains its own pixels.
///
/// # Shapes
/// `frame [B, 3, H, W]`, `log_masks [B, K, 1, H, W]`, `components [B, K, 3, H, W]`.
pub fn mixture_log_likelihood(
    frame: &Tensor,
    log_masks: &Tensor,
    components: &Tensor,
    sigma: f64,
) -> Tensor {
    let density = normal_log_density(&frame.unsqueeze(1), components, sigma);
    sum(&(log_masks + density).logsumexp(1, false))
}

/// log [α N(frame | o_fg, sigma²) + (1 - α) Σ_k π_k N(frame | o_k, sigma²)] per pixel and channel, summed, `[B]`:
/// objects and slots compete for every pixel (mixture spec 5, form c; after SPACE).
///
/// # Shapes
/// `foreground [B, 3, H, W]`, not premultiplied; `alpha [B, 1, H, W]` in [0, 1]; the rest as in
/// [`mixture_log_likelihood`].
pub fn joint_log_likelihood(
    frame: &Tensor,
    foreground: &Tensor,
    alpha: &Tensor,
    log_masks: &Tensor,
    components: &Tensor,
    sigma: f64,
) -> Tensor {
    let slots = log_masks + normal_log_density(&frame.unsqueeze(1), components, sigma);
    let rest: Tensor = 1.0 - alpha;
    let background = slots.logsumexp(1, false) + rest.clamp_min(EPS).log();
    let objects = normal_log_density(frame, foreground, sigma) + alpha.clamp_min(EPS).log();
    sum(&background.logaddexp(&objects))
}

/// The image of the fixed-alpha window: foreground over the mixture weighted by a constant (object spec 6.6).
pub fn fixed_alpha_image(foreground: &Tensor, mu_mix: &Tensor, alpha: f64) -> Tensor {
    foreground + mu_mix * (1.0 - alpha)
}

/// KL of mask and component latents to their priors, summed over slots and dimensions, `[B]` each.
///
/// # Panics
/// If the step was made without priors.
pub fn mixture_kl(step: &MixtureStep) -> (Tensor, Tensor) {
    let (mask, comp): &(Normal, Normal) =
        step.priors.as_ref().expect("the step was asked for priors");
    (sum(&step.mask_raw.kl(mask)), sum(&step.comp_raw.kl(comp)))
}

/// Σ_k ‖Δ MLP_res‖₂ of masks and components, `[B]`; 0 on rows whose frame is the first.
pub fn residual_norm(step: &MixtureStep, first: &Tensor) -> Tensor {
    // The norm has no gradient at exactly 0.
    let norm = |x: &Tensor| {
        (x.square().sum_dim_intlist(-1, false, Kind::Float) + 1e-12).sqrt() // [B, K]
    };
    let (mask, comp) = &step.residuals;
    let norms = (norm(mask) + norm(comp)).sum_dim_intlist(1, false, Kind::Float);
    norms.masked_fill(first, 0.0)
}

/// Σ (gamma - π^r)² over pixels, `[B]`; both are `[B, 1, H, W]`.
pub fn keypoint_regression(gamma: &Tensor, agent_mask: &Tensor) -> Tensor {
    sum(&(gamma - agent_mask).square())
}

/// Sum over everything but the batch.
fn sum(x: &Tensor) -> Tensor {
    x.flatten(1, -1).sum_dim_intlist(1, false, Kind::Float)
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    #[test]
    fn a_mixture_with_one_opaque_slot_is_a_gaussian() {
        let options = (Kind::Float, Device::Cpu);
        let frame = Tensor::full([2, 3, 4, 4], 0.3, options);
        let components = Tensor::cat(
            &[
                Tensor::full([2, 1, 3, 4, 4], 0.25, options),
                Tensor::zeros([2, 1, 3, 4, 4], options),
            ],
            1,
        );
        let masks = Tensor::cat(
            &[
                Tensor::ones([2, 1, 1, 4, 4], options),
                Tensor::full([2, 1, 1, 4, 4], 1e-30, options),
            ],
            1,
        );
        let mixture = mixture_log_likelihood(&frame, &masks.log(), &components, 0.1);
        let gaussian = gaussian_log_likelihood(&frame, &components.select(1, 0), 0.1);
        assert!((mixture - gaussian).abs().max().double_value(&[]) < 1e-3);
    }
}
