//! Crops of images around objects.

use tch::Tensor;

use super::{
    parallel::for_each,
    tensor::{numbers, numbers_mut, room},
};

/// Cuts `side x side` glimpses out of images: bilinear, zeros outside, as `nn::spatial_transformer::crop`.
///
/// # Shapes
/// `image [B, C, H, W]`, `z_where [B, N, 4]`; returns `[B, N, C, side, side]`.
pub(crate) fn crop(image: &Tensor, z_where: &Tensor, side: i64) -> Tensor {
    let (image, boxes) = (image.contiguous(), z_where.contiguous());
    let (batch, channels, height, width) = image.size4().expect("an image batch has four axes");
    let count = boxes.size()[1];
    let mut glimpses = room(&[batch, count, channels, side, side]);
    let [channels, height, width, side] = [channels, height, width, side].map(|x| x as usize);
    let (image, boxes) = (numbers(&image), numbers(&boxes));
    let size = channels * side * side;
    for_each(numbers_mut(&mut glimpses), size, |glimpse, out| {
        let &[scale_x, scale_y, shift_x, shift_y] = &boxes[glimpse * 4..][..4] else {
            unreachable!("boxes are four numbers")
        };
        let columns = taps(side, width, scale_x, shift_x);
        let rows = taps(side, height, scale_y, shift_y);
        let image = &image[glimpse / count as usize * channels * height * width..];
        let planes = image.chunks_exact(height * width).zip(out.chunks_exact_mut(side * side));
        for (plane, out) in planes {
            for (row, out) in rows.iter().zip(out.chunks_exact_mut(side)) {
                let low = &plane[row.low * width..][..width];
                let high = &plane[row.high * width..][..width];
                for (column, x) in columns.iter().zip(out) {
                    let line = |line: &[f32]| {
                        line[column.low] * column.low_weight
                            + line[column.high] * column.high_weight
                    };
                    *x = line(low) * row.low_weight + line(high) * row.high_weight;
                }
            }
        }
    });
    glimpses
}

/// The two pixels of a line between which a sample lies; those outside weigh nothing.
#[derive(Clone, Copy)]
struct Tap {
    low: usize,
    high: usize,
    low_weight: f32,
    high_weight: f32,
}

fn taps(side: usize, pixels: usize, scale: f32, shift: f32) -> Vec<Tap> {
    let last = pixels as f32 - 1.0;
    // Rounded as libtorch rounds: crops of steep edges tell.
    let step = 2.0 / (side as f32 - 1.0).max(1.0);
    let tap = |i: usize| {
        let edge =
            if i < side / 2 { step * i as f32 - 1.0 } else { 1.0 - step * (side - i - 1) as f32 };
        let centre = edge * (side as f32 - 1.0) / side as f32;
        let at = (scale * centre + shift + 1.0) * (pixels as f32 / 2.0) - 0.5;
        let low = at.floor();
        let share = at - low;
        let weight = |at: f32, weight: f32| if (0.0..=last).contains(&at) { weight } else { 0.0 };
        let clamped = |at: f32| at.clamp(0.0, last) as usize;
        Tap {
            low: clamped(low),
            high: clamped(low + 1.0),
            low_weight: weight(low, 1.0 - share),
            high_weight: weight(low + 1.0, share),
        }
    };
    (0..side).map(tap).collect()
}

#[cfg(test)]
mod tests {
    use tch::{Device, Kind};

    use super::*;

    #[test]
    fn crops_are_those_of_libtorch() {
        let image = (Tensor::arange(2 * 3 * 64 * 64, (Kind::Float, Device::Cpu)) * 0.37).sin();
        let image = image.view([2, 3, 64, 64]);
        let boxes = [
            [0.2f32, 0.3, 0.1, -0.2],
            [0.5, 0.1, 0.9, -0.9],
            [1.2, 1.0, 0.0, 0.0],
            [0.3, 0.3, 3.0, 0.0],
            [0.0, 0.0, 1e9, -1e9],
            [0.1, 0.1, -1.0, 1.0],
        ];
        let boxes = Tensor::from_slice(&boxes.concat()).view([2, 3, 4]);
        let plain = crate::nn::spatial_transformer::crop(&image, &boxes, 16);
        let difference = (crop(&image, &boxes, 16) - plain).abs().max().double_value(&[]);
        assert!(difference < 1e-4, "{difference}");
    }
}
