//! What lies between the mixture's decoders and its image, pixel by pixel.

use tch::Tensor;

use super::{
    lanes::{Lanes, versions},
    math::{exp_negative, ln_1p, sigmoid},
    parallel::for_each,
    tensor::{numbers, numbers_mut, room},
};

/// Stick breaking in log space (mixture spec 2.2).
///
/// # Shapes
/// Logits `[B, K-1, 1, H, W]` to log masks `[B, K, 1, H, W]`.
pub(crate) fn break_sticks(logits: &Tensor) -> Tensor {
    let logits = logits.contiguous();
    let (batch, rest, _, height, width) = logits.size5().expect("logits have five axes");
    let mut masks = room(&[batch, rest + 1, 1, height, width]);
    let (pixels, rest) = ((height * width) as usize, rest as usize);
    let logits = numbers(&logits);
    for_each(numbers_mut(&mut masks), (rest + 1) * pixels, |row, masks| {
        sticks(&logits[row * rest * pixels..][..rest * pixels], masks, pixels);
    });
    masks
}

/// `mu_mix = Σ_k π_k o_k`.
///
/// # Shapes
/// Log masks `[B, K, 1, H, W]` and images `[B, K, 3, H, W]`; returns `[B, 3, H, W]`.
pub(crate) fn mix(log_masks: &Tensor, components: &Tensor) -> Tensor {
    let (log_masks, components) = (log_masks.contiguous(), components.contiguous());
    let (batch, slots, channels, height, width) = components.size5().expect("five axes");
    let mut mixed = room(&[batch, channels, height, width]);
    let (pixels, slots, channels) = ((height * width) as usize, slots as usize, channels as usize);
    let (log_masks, components) = (numbers(&log_masks), numbers(&components));
    for_each(numbers_mut(&mut mixed), channels * pixels, |row, mixed| {
        let size = slots * pixels;
        let masks = &log_masks[row * size..][..size];
        weigh(masks, &components[row * size * channels..][..size * channels], mixed, pixels);
    });
    mixed
}

/// Sigmoid of images `[N, C, h, h]`, enlarged bilinearly to `side` beforehand if they are smaller.
pub(crate) fn enlarge_to(images: &Tensor, side: i64, squash: bool) -> Tensor {
    let images = images.contiguous();
    let (batch, channels, height, _) = images.size4().expect("images have four axes");
    let mut large = room(&[batch, channels, side, side]);
    let (small, side) = (height as usize, side as usize);
    let images = numbers(&images);
    let taps = Taps::new(small, side);
    for_each(numbers_mut(&mut large), side * side, |plane, large| {
        resample(&images[plane * small * small..][..small * small], &taps, large, squash);
    });
    large
}

/// Where each pixel of an enlarged line comes from.
struct Taps {
    small: usize,
    low: Vec<usize>,
    high: Vec<usize>,
    /// Share of the higher one.
    share: Vec<f32>,
}

impl Taps {
    fn new(small: usize, side: usize) -> Self {
        let at = |i: usize| ((i as f32 + 0.5) * (small as f32 / side as f32) - 0.5).max(0.0);
        let low: Vec<usize> = (0..side).map(|i| (at(i) as usize).min(small - 1)).collect();
        Self {
            small,
            high: low.iter().map(|low| (low + 1).min(small - 1)).collect(),
            share: (0..side).map(|i| at(i) - low[i] as f32).collect(),
            low,
        }
    }
}

versions! {
    fn sticks(logits: &[f32], masks: &mut [f32], pixels: usize) = sticks_in
}

versions! {
    fn weigh(masks: &[f32], components: &[f32], mixed: &mut [f32], pixels: usize) = weigh_in
}

versions! {
    fn resample(image: &[f32], taps: &Taps, large: &mut [f32], squash: bool) = resample_in
}

#[inline(always)]
fn sticks_in<L: Lanes>(logits: &[f32], masks: &mut [f32], pixels: usize) {
    // The mask to come holds what is left, in log space.
    masks[..pixels].fill(0.0);
    for (k, logits) in logits.chunks_exact(pixels).enumerate() {
        let (masks, left) = masks[k * pixels..].split_at_mut(pixels);
        for ((mask, left), logit) in masks.iter_mut().zip(&mut left[..pixels]).zip(logits) {
            let common = ln_1p::<L>(exp_negative::<L>(-logit.abs()));
            let scope = *mask;
            *mask = scope + (if *logit < 0.0 { *logit } else { 0.0 }) - common;
            *left = scope - (if *logit > 0.0 { *logit } else { 0.0 }) - common;
        }
    }
}

#[inline(always)]
fn weigh_in<L: Lanes>(masks: &[f32], components: &[f32], mixed: &mut [f32], pixels: usize) {
    let channels = mixed.len() / pixels;
    let mut weights = vec![0.0; pixels];
    mixed.fill(0.0);
    let slots = masks.chunks_exact(pixels).zip(components.chunks_exact(channels * pixels));
    for (masks, component) in slots {
        for (weight, mask) in weights.iter_mut().zip(masks) {
            *weight = exp_negative::<L>(*mask);
        }
        let planes = mixed.chunks_exact_mut(pixels).zip(component.chunks_exact(pixels));
        for (sum, plane) in planes {
            for ((sum, x), weight) in sum.iter_mut().zip(plane).zip(&weights) {
                *sum = L::fused(*weight, *x, *sum);
            }
        }
    }
}

#[inline(always)]
fn resample_in<L: Lanes>(image: &[f32], taps: &Taps, large: &mut [f32], squash: bool) {
    let side = taps.low.len();
    let mut line = vec![0.0; taps.small];
    for (row, out) in large.chunks_exact_mut(side).enumerate() {
        let low = &image[taps.low[row] * taps.small..][..taps.small];
        let high = &image[taps.high[row] * taps.small..][..taps.small];
        let share = taps.share[row];
        for ((x, low), high) in line.iter_mut().zip(low).zip(high) {
            *x = L::fused(share, *high - *low, *low);
        }
        for (i, x) in out.iter_mut().enumerate() {
            let (low, high) = (line[taps.low[i]], line[taps.high[i]]);
            *x = L::fused(taps.share[i], high - low, low);
        }
        if squash {
            for x in out {
                *x = sigmoid::<L>(*x);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use tch::{Device, Kind};

    use super::*;

    fn close(a: &Tensor, b: &Tensor) {
        let difference = (a - b).abs().max().double_value(&[]);
        assert!(difference < 2e-6, "{difference}");
    }

    #[test]
    fn kernels_agree_with_libtorch() {
        let wave = |shape: &[i64], scale: f64| {
            let line = Tensor::arange(shape.iter().product::<i64>(), (Kind::Float, Device::Cpu));
            ((line * 0.37).sin() * scale).view(shape)
        };
        let logits = wave(&[2, 3, 1, 5, 5], 30.0);
        let masks = break_sticks(&logits);
        let left = (-&logits).log_sigmoid().cumsum(1, Kind::Float);
        let nothing = left.narrow(1, 0, 1).zeros_like();
        let expected =
            Tensor::cat(&[&nothing, &left], 1) + Tensor::cat(&[&logits.log_sigmoid(), &nothing], 1);
        close(&(&masks / (&expected.abs() + 1.0)), &(&expected / (&expected.abs() + 1.0)));
        let images = wave(&[2, 4, 3, 5, 5], 1.0);
        let mixed = (masks.exp() * &images).sum_dim_intlist(1, false, Kind::Float);
        close(&mix(&masks, &images), &mixed);
        let image = wave(&[2, 3, 5, 5], 4.0);
        let large = image.upsample_bilinear2d([13, 13], false, None, None);
        close(&enlarge_to(&image, 13, false), &large);
        close(&enlarge_to(&image, 13, true), &large.sigmoid());
    }
}
