//! Likelihoods and penalties of the objective, each with its gradient (mixture spec 5, object spec 3.8 and
//! 6.6). Weights, schedules and the sum over time belong to training.

use tch::{Kind, Tensor};

use super::{mixture::MixtureStep, objects::Placed};
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

/// How far two of a colour may be apart in it, in [0, 1]: the standard deviation of the image likelihood.
const SAME_COLOUR: f64 = 0.1;

/// Distances between where objects are drawn and where discovery draws them, `[B]`, summed over objects as far as they are
/// present.
///
/// An object is drawn to the detections of its colour within some `reach` of it that no other object is at, the nearest
/// most; one without any near it pays nothing. Distances count as in [`lenient`] and are in units of the image's half side,
/// as `reach` and `scale` are. Only the objects' centres get a gradient.
pub fn following(objects: &Placed, found: &Placed, reach: f64, scale: f64) -> Tensor {
    let distance = squared_distances(objects, found);
    let weight = likely_finds(objects, found, &distance, reach, scale);
    sum(&(weight * lenient(&distance, scale) * objects.presence.detach()))
}

/// How surely each object is where it is thought to be, `[B, N]` in [0, 1]: it is among what was found there, of its colour,
/// and no other object is. `reach` and `scale` are as in [`following`]; there is no gradient.
pub fn confirmed(objects: &Placed, found: &Placed, reach: f64, scale: f64) -> Tensor {
    let distance = squared_distances(objects, found);
    let weight = likely_finds(objects, found, &distance, reach, scale);
    weight.sum_dim_intlist(-1, false, Kind::Float)
}

/// How likely each object is each of what was `found` at squared distances `[B, N, D]`, `[B, N, D]` in [0, 1] without a
/// gradient; sums to less than 1 over finds, and to 0 where there is none.
fn likely_finds(
    objects: &Placed,
    found: &Placed,
    distance: &Tensor,
    reach: f64,
    scale: f64,
) -> Tensor {
    let far = distance.detach();
    let other = objects.colour.unsqueeze(2) - found.colour.unsqueeze(1); // [B, N, D, 3]
    let other = other.detach().square().sum_dim_intlist(-1, false, Kind::Float);
    let unlike = &far / reach.powi(2) + other / SAME_COLOUR.powi(2);
    let presence = objects.presence.detach();
    let at = (far * (-0.5 / scale.powi(2))).exp() * &presence; // [B, N, D]
    let itself = Tensor::eye(at.size()[1], (Kind::Bool, at.device())).unsqueeze(-1);
    let by_others = at.unsqueeze(1).masked_fill(&itself, 0.0).amax(2, false);
    let detected = found.presence.detach().transpose(1, 2); // [B, 1, D]
    let near: Tensor = (unlike * -0.5).exp() * detected * (1.0 - by_others);
    // As much as a detection at twice the reach: beyond it the weights fade.
    let nowhere = (-2.0_f64).exp();
    &near / (near.sum_dim_intlist(-1, true, Kind::Float) + nowhere)
}

/// Distances between where objects are imagined and where they are when they are seen, `[B]`, summed over pairs of the same
/// identity as far as both are present; multi-step predictions are judged by what is inferred from the frames, as in latent
/// overshooting (Hafner et al. 2019).
///
/// Distances count as in [`lenient`] and are in units of the image's half side, as `scale` is. Only the imagined objects'
/// centres get a gradient.
pub fn foresight(imagined: Identified<'_>, seen: Identified<'_>, scale: f64) -> Tensor {
    let distance = lenient(&squared_distances(imagined.0, seen.0), scale);
    sum(&(distance * same_objects(imagined, seen)))
}

/// Squared differences between what is drawn of objects when they are imagined and when they are seen, mean over pixels of
/// the glimpse, `[B]`, summed over channels and over the pairs of [`foresight`]. The image alone would have objects fade
/// where it is not sure of their places. Only what is drawn of imagined objects gets a gradient.
pub fn lasting(imagined: Identified<'_>, seen: Identified<'_>) -> Tensor {
    let difference = imagined.0.drawn.unsqueeze(2) - seen.0.drawn.detach().unsqueeze(1); // [B, N, M, 4, s, s]
    let pixels = [4i64, 5].as_slice();
    let difference = difference.square().mean_dim(pixels, false, Kind::Float);
    let difference = difference.sum_dim_intlist(-1, false, Kind::Float);
    sum(&(difference * same_objects(imagined, seen)))
}

/// Objects and their identities, `[B, N]` int64, negative in slots that were never filled.
type Identified<'a> = (&'a Placed, &'a Tensor);

/// How far two objects are the same and both present, `[B, N, M]` in [0, 1], without a gradient.
fn same_objects((some, ids): Identified<'_>, (others, other_ids): Identified<'_>) -> Tensor {
    let ids = ids.unsqueeze(2);
    let same = ids.eq_tensor(&other_ids.unsqueeze(1)).logical_and(&ids.ge(0));
    let both = some.presence.detach() * others.presence.detach().transpose(1, 2);
    both * same.to_kind(Kind::Float)
}

/// Distances between places `[..., 2]`, each as in [`lenient`] with a `scale` in their unit, `[...]`.
pub fn displacement(some: &Tensor, others: &Tensor, scale: f64) -> Tensor {
    let squared = (some - others).square().sum_dim_intlist(-1, false, Kind::Float);
    lenient(&squared, scale)
}

/// Distances that count squared up to about `scale` and linearly beyond it (pseudo-Huber), of squared ones: an object that is
/// lost must not outweigh all others.
fn lenient(squared: &Tensor, scale: f64) -> Tensor {
    let unit = 2.0 * scale.powi(2);
    ((squared / scale.powi(2) + 1.0).sqrt() - 1.0) * unit
}

/// Squared distances between where `objects` and `others` are drawn, `[B, N, M]`; only the objects' centres get a gradient.
fn squared_distances(objects: &Placed, others: &Placed) -> Tensor {
    let drawn = |placed: &Placed| &placed.centre + placed.offset.detach();
    let offset = drawn(objects).unsqueeze(2) - drawn(others).detach().unsqueeze(1); // [B, N, M, 2]
    offset.square().sum_dim_intlist(-1, false, Kind::Float)
}

/// Squared distances between where objects are drawn and the centres of their boxes, `[B]`, in units of the image's half
/// side, summed over objects as far as they are present. Only what is drawn gets a gradient.
pub fn centring(objects: &Placed) -> Tensor {
    sum(&(objects.offset.square() * objects.presence.detach()))
}

/// Sum over everything but the batch.
fn sum(x: &Tensor) -> Tensor {
    x.flatten(1, -1).sum_dim_intlist(1, false, Kind::Float)
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    /// Grey objects given as presence, centre x, y, offset x, y.
    fn placed(objects: &[[f32; 5]]) -> Placed {
        let all = Tensor::from_slice(&objects.concat()).view([1, -1, 5]);
        let part = |from, width| all.narrow(-1, from, width).copy();
        let (count, grey) = (objects.len() as i64, (Kind::Float, Device::Cpu));
        Placed {
            presence: part(0, 1),
            centre: part(1, 2),
            offset: part(3, 2),
            colour: Tensor::full([1, count, 3], 0.5, grey),
            drawn: Tensor::full([1, count, 4, 2, 2], 0.5, grey),
        }
    }

    /// What a distance counts with a scale of 2.
    fn lenient_2(distance: f64) -> f64 {
        ((distance * distance / 4.0 + 1.0).sqrt() - 1.0) * 8.0
    }

    /// The slope of that, over the distance.
    fn slope_2(distance: f64) -> f64 {
        2.0 / (distance * distance / 4.0 + 1.0).sqrt()
    }

    #[test]
    fn an_object_is_drawn_to_what_is_found_near_it() {
        // One object drawn two units left of a detection, one far from all, one absent.
        let mut objects = placed(&[
            [1.0, 33.0, 20.0, -1.0, 0.0],
            [1.0, 3.0, 20.0, 0.0, 0.0],
            [0.0, 33.0, 20.0, 0.0, 0.0],
        ]);
        objects.centre = objects.centre.set_requires_grad(true);
        let found = placed(&[[1.0, 36.0, 20.0, -2.0, 0.0], [0.0, 31.0, 20.0, 0.0, 0.0]]);
        let loss = following(&objects, &found, 4.0, 2.0);
        let near = (-0.5_f64 * 4.0 / 16.0).exp();
        let weight = near / (near + (-2.0_f64).exp());
        assert!((loss.double_value(&[0]) - lenient_2(2.0) * weight).abs() < 1e-3, "{loss}");
        let sure = confirmed(&objects, &found, 4.0, 2.0);
        assert!((sure.double_value(&[0, 0]) - weight).abs() < 1e-3, "{sure}");
        assert!(sure.double_value(&[0, 1]) < 1e-3, "{sure}");
        loss.sum(Kind::Float).backward();
        let gradient = objects.centre.grad();
        let of = |object: i64| gradient.double_value(&[0, object, 0]);
        assert!((of(0) + 2.0 * slope_2(2.0) * weight).abs() < 1e-3, "{gradient}");
        assert!(of(1).abs() < 1e-3 && of(2).abs() < 1e-6, "{gradient}");
    }

    #[test]
    fn an_object_is_drawn_to_no_other_colour_and_not_to_where_another_is() {
        let grey = |x: f32| [1.0, x, 20.0, 0.0, 0.0];
        let mut found = placed(&[grey(34.0), grey(39.0)]);
        found.colour = Tensor::from_slice(&[0.9f32, 0.1, 0.1, 0.5, 0.5, 0.5]).view([1, 2, 3]);
        // The one of its colour is farther.
        let near = (-0.5_f64 * 36.0 / 64.0).exp();
        let expected = lenient_2(6.0) * near / (near + (-2.0_f64).exp());
        let loss = following(&placed(&[grey(33.0)]), &found, 8.0, 2.0).double_value(&[0]);
        assert!((loss - expected).abs() < 1e-3, "{loss} instead of {expected}");
        let loss = following(&placed(&[grey(33.0), grey(39.0)]), &found, 8.0, 2.0);
        assert!(loss.double_value(&[0]) < 1e-3, "{loss}");
    }

    #[test]
    fn an_imagined_object_is_led_to_where_the_same_one_is_seen() {
        let mut imagined = placed(&[[1.0, 10.0, 20.0, 0.0, 0.0], [0.5, 30.0, 20.0, 0.0, 0.0]]);
        imagined.centre = imagined.centre.set_requires_grad(true);
        let seen = placed(&[[1.0, 30.0, 20.0, 0.0, 0.0], [1.0, 13.0, 24.0, 0.0, 0.0]]);
        let ids = |ids: [i64; 2]| Tensor::from_slice(&ids).unsqueeze(0);
        // The first is five units off, the second is nobody's.
        let loss = foresight((&imagined, &ids([4, -1])), (&seen, &ids([-1, 4])), 2.0);
        assert!((loss.double_value(&[0]) - lenient_2(5.0)).abs() < 1e-4, "{loss}");
        loss.sum(Kind::Float).backward();
        let gradient = imagined.centre.grad();
        let of = |object: i64, axis: i64| gradient.double_value(&[0, object, axis]);
        for (axis, off) in [(0, 3.0), (1, 4.0)] {
            assert!((of(0, axis) + off * slope_2(5.0)).abs() < 1e-4, "{gradient}");
        }
        assert!(of(1, 0).abs() < 1e-6 && of(1, 1).abs() < 1e-6, "{gradient}");
    }

    #[test]
    fn an_imagined_object_is_led_to_how_the_same_one_is_seen() {
        let object = |pres: f32| [pres, 10.0, 20.0, 0.0, 0.0];
        let mut imagined = placed(&[object(1.0), object(1.0)]);
        imagined.drawn = imagined.drawn.set_requires_grad(true);
        let mut seen = placed(&[object(0.5), object(1.0)]);
        let channels = Tensor::from_slice(&[0.5f32, 0.7, 0.5, 0.9]).view([1, 1, 4, 1, 1]);
        seen.drawn = channels.expand([1, 2, 4, 2, 2], false);
        let ids = |ids: [i64; 2]| Tensor::from_slice(&ids).unsqueeze(0);
        let loss = lasting((&imagined, &ids([4, -1])), (&seen, &ids([4, -1])));
        assert!((loss.double_value(&[0]) - 0.5 * (0.04 + 0.16)).abs() < 1e-6, "{loss}");
        loss.sum(Kind::Float).backward();
        let of = |object: i64| imagined.drawn.grad().double_value(&[0, object, 3, 0, 0]);
        assert!((of(0) + 0.5 * 2.0 * 0.4 / 4.0).abs() < 1e-6 && of(1).abs() < 1e-9, "{}", of(0));
    }

    #[test]
    fn what_is_drawn_beside_the_centre_of_its_box_pays_as_far_as_it_is_present() {
        let loss = centring(&placed(&[[1.0, 5.0, 6.0, 3.0, 4.0], [0.5, 5.0, 6.0, 0.0, 2.0]]));
        assert!((loss.double_value(&[0]) - 27.0).abs() < 1e-5, "{loss}");
    }

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
