//! Images with a border, and what happens to them after a convolution.

use tch::Tensor;

use super::{
    conv::{Strides, numbers},
    lanes::{Lanes, versions},
    math::elu,
};

/// Epsilon of group normalisation.
const EPS: f64 = 1e-5;

/// A square image of `channels` numbers a pixel, with a border of zeros for the next convolution to reach into.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) struct Shape {
    pub(super) side: usize,
    pub(super) channels: usize,
    pub(super) border: usize,
}

impl Shape {
    /// Numbers in a row, border included.
    pub(super) fn row(self) -> usize {
        (self.side + 2 * self.border) * self.channels
    }

    /// Numbers in an image, border included.
    pub(super) fn floats(self) -> usize {
        (self.side + 2 * self.border) * self.row()
    }

    /// Where the pixels lie.
    pub(super) fn strides(self) -> Strides {
        Strides {
            start: self.border * (self.row() + self.channels),
            image: self.floats(),
            row: self.row(),
            pixel: self.channels,
        }
    }

    /// The rows of an image without its border.
    fn rows(self, image: &mut [f32]) -> impl Iterator<Item = &mut [f32]> {
        let Strides { start, row, .. } = self.strides();
        let rows = image[start..].chunks_mut(row).take(self.side);
        rows.map(move |line| &mut line[..self.side * self.channels])
    }
}

/// An activation.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(crate) enum Curve {
    /// None.
    Identity,
    /// ELU or CELU with alpha 1.
    Elu,
    /// Negative numbers to zero.
    Relu,
}

/// Group normalisation.
#[derive(Debug)]
pub(crate) struct Groups {
    count: usize,
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Groups {
    pub(crate) fn new(groups: i64, weight: &Tensor, bias: &Tensor) -> Self {
        Self { count: groups as usize, weight: numbers(weight), bias: numbers(bias) }
    }
}

/// What follows a convolution: an activation, then a normalisation.
#[derive(Debug)]
pub(crate) struct After {
    pub(crate) curve: Curve,
    pub(crate) norm: Option<Groups>,
}

impl After {
    /// An activation alone.
    pub(crate) fn only(curve: Curve) -> Self {
        Self { curve, norm: None }
    }

    /// Applies it to an image.
    pub(super) fn apply(&self, image: &mut [f32], shape: Shape) {
        match &self.norm {
            Some(norm) => {
                let mut affine = vec![0.0; 2 * shape.channels];
                bend_and_measure(image, shape, self.curve, norm, &mut affine);
                scale(image, shape, &affine);
            }
            None if self.curve == Curve::Identity => {}
            None => bend(image, shape, self.curve),
        }
    }
}

versions! {
    fn bend(image: &mut [f32], shape: Shape, curve: Curve) = bend_in
}

versions! {
    /// Activates, and finds factor and offset of each channel.
    fn bend_and_measure(
        image: &mut [f32],
        shape: Shape,
        curve: Curve,
        norm: &Groups,
        affine: &mut [f32],
    ) = bend_and_measure_in
}

versions! {
    fn scale(image: &mut [f32], shape: Shape, affine: &[f32]) = scale_in
}

versions! {
    /// `max(image + other, 0)`, pixel by pixel of an image without border.
    pub(super) fn add_and_rectify(
        image: &mut [f32],
        shape: Shape,
        other: &[f32],
        other_shape: Shape,
    ) = add_and_rectify_in
}

versions! {
    /// ELU of `map + vector`, the vector the same at every pixel.
    pub(super) fn spread(map: &[f32], vector: &[f32], image: &mut [f32], shape: Shape) = spread_in
}

#[inline(always)]
fn bend_in<L: Lanes>(image: &mut [f32], shape: Shape, curve: Curve) {
    for row in shape.rows(image) {
        bend_row::<L>(row, curve);
    }
}

#[inline(always)]
fn bend_row<L: Lanes>(row: &mut [f32], curve: Curve) {
    match curve {
        Curve::Identity => {}
        // Loops, not closures: a closure is a function without the instructions of its caller.
        Curve::Elu => {
            for x in row {
                *x = elu::<L>(*x);
            }
        }
        Curve::Relu => {
            for x in row {
                *x = if *x < 0.0 { 0.0 } else { *x };
            }
        }
    }
}

#[inline(always)]
fn bend_and_measure_in<L: Lanes>(
    image: &mut [f32],
    shape: Shape,
    curve: Curve,
    norm: &Groups,
    affine: &mut [f32],
) {
    let channels = shape.channels;
    let mut totals = vec![[0.0f64; 2]; norm.count];
    let width = channels / norm.count;
    let (sums, squares) = affine.split_at_mut(channels);
    for row in shape.rows(image) {
        bend_row::<L>(row, curve);
        sums.fill(0.0);
        squares.fill(0.0);
        measure_row::<L>(row, sums, squares);
        let parts = sums.chunks_exact(width).zip(squares.chunks_exact(width));
        for ([total, total_square], (sums, squares)) in totals.iter_mut().zip(parts) {
            for (sum, square) in sums.iter().zip(squares) {
                *total += f64::from(*sum);
                *total_square += f64::from(*square);
            }
        }
    }
    let count = (shape.side * shape.side * width) as f64;
    for (group, [total, total_square]) in totals.into_iter().enumerate() {
        let mean = total / count;
        let variance = (total_square / count - mean * mean).max(0.0);
        let inverse = 1.0 / (variance + EPS).sqrt();
        for channel in group * width..(group + 1) * width {
            let factor = inverse * f64::from(norm.weight[channel]);
            sums[channel] = factor as f32;
            squares[channel] = (f64::from(norm.bias[channel]) - mean * factor) as f32;
        }
    }
}

/// Numbers whose sums are kept in registers.
const BLOCK: usize = 32;

/// Adds each channel of a row's pixels, and its square, to `sums` and `squares`.
#[inline(always)]
fn measure_row<L: Lanes>(row: &[f32], sums: &mut [f32], squares: &mut [f32]) {
    let channels = sums.len();
    if BLOCK.is_multiple_of(channels) && row.len().is_multiple_of(BLOCK) {
        let (mut sum, mut square) = ([0.0; BLOCK], [0.0; BLOCK]);
        for pixels in row.chunks_exact(BLOCK) {
            add_block::<L>(pixels, &mut sum, &mut square);
        }
        for i in 0..BLOCK {
            sums[i % channels] += sum[i];
            squares[i % channels] += square[i];
        }
    } else if channels.is_multiple_of(BLOCK) {
        for first in (0..channels).step_by(BLOCK) {
            let (mut sum, mut square) = ([0.0; BLOCK], [0.0; BLOCK]);
            for pixel in row.chunks_exact(channels) {
                add_block::<L>(&pixel[first..first + BLOCK], &mut sum, &mut square);
            }
            sums[first..first + BLOCK].copy_from_slice(&sum);
            squares[first..first + BLOCK].copy_from_slice(&square);
        }
    } else {
        for pixel in row.chunks_exact(channels) {
            for ((x, sum), square) in pixel.iter().zip(&mut *sums).zip(&mut *squares) {
                *sum += x;
                *square = L::fused(*x, *x, *square);
            }
        }
    }
}

#[inline(always)]
fn add_block<L: Lanes>(numbers: &[f32], sum: &mut [f32; BLOCK], square: &mut [f32; BLOCK]) {
    for ((x, sum), square) in numbers.iter().zip(sum).zip(square) {
        *sum += x;
        *square = L::fused(*x, *x, *square);
    }
}

#[inline(always)]
fn scale_in<L: Lanes>(image: &mut [f32], shape: Shape, affine: &[f32]) {
    let (factors, offsets) = affine.split_at(shape.channels);
    for row in shape.rows(image) {
        for pixel in row.chunks_exact_mut(shape.channels) {
            for ((x, factor), offset) in pixel.iter_mut().zip(factors).zip(offsets) {
                *x = L::fused(*x, *factor, *offset);
            }
        }
    }
}

#[inline(always)]
fn add_and_rectify_in<L: Lanes>(
    image: &mut [f32],
    shape: Shape,
    other: &[f32],
    other_shape: Shape,
) {
    let Strides { start, row, .. } = other_shape.strides();
    for (line, other) in shape.rows(image).zip(other[start..].chunks(row)) {
        for (x, y) in line.iter_mut().zip(other) {
            let sum = *x + *y;
            *x = if sum < 0.0 { 0.0 } else { sum };
        }
    }
}

#[inline(always)]
fn spread_in<L: Lanes>(map: &[f32], vector: &[f32], image: &mut [f32], shape: Shape) {
    let channels = shape.channels;
    for (row, map) in shape.rows(image).zip(map.chunks_exact(shape.side * channels)) {
        for (pixel, map) in row.chunks_exact_mut(channels).zip(map.chunks_exact(channels)) {
            for ((x, map), y) in pixel.iter_mut().zip(map).zip(vector) {
                *x = map + y;
            }
        }
        bend_row::<L>(row, Curve::Elu);
    }
}
