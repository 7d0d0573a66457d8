//! Convolutions of images whose pixels hold their channels side by side.
//!
//! A tile of neighbouring pixels times one or two vectors of output channels stays in registers while the kernel's taps
//! and the input channels pass by: the inner loop of a matrix product, without a matrix being built. The taps of one
//! kernel row are neighbours in memory, so each row of the kernel is one run.

use tch::Tensor;

use super::{
    lanes::{Lanes, level, versions},
    map::Shape,
};

/// Weights above this many bytes are kept in the cache while all images pass, instead of an image while all weights do.
const HEAVY: usize = 1 << 18;

/// Images with rows shorter than this make poor tiles.
const FEW: usize = 6;

/// A convolution with its weights in the order in which the tiles read them.
#[derive(Debug)]
pub(crate) struct Conv {
    /// Panels of one or two vectors of output channels; in each `[kernel, kernel * inputs, lanes]`.
    weights: Vec<f32>,
    /// Padded with zeros to whole vectors.
    bias: Vec<f32>,
    pub(super) kernel: usize,
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    pub(super) stride: usize,
    pub(super) padding: usize,
}

/// Where the numbers of a batch of images lie.
#[derive(Clone, Copy, Debug)]
pub(super) struct Strides {
    /// The first number.
    pub(super) start: usize,
    /// From image to image, row to row, pixel to pixel.
    pub(super) image: usize,
    pub(super) row: usize,
    pub(super) pixel: usize,
}

impl Strides {
    /// Offset behind the last number of `channels` at the last of `images`, `rows` and `columns`.
    fn end(&self, images: usize, rows: usize, columns: usize, channels: usize) -> usize {
        let Self { start, image, row, pixel } = self;
        start + (images - 1) * image + (rows - 1) * row + (columns - 1) * pixel + channels
    }
}

impl Conv {
    /// From `weight [out, in, k, k]` and `bias [out]`.
    pub(crate) fn new(weight: &Tensor, bias: Option<&Tensor>, stride: i64, padding: i64) -> Self {
        let (outputs, inputs, kernel, _) = weight.size4().expect("a kernel has four axes");
        let [outputs, inputs, kernel] = [outputs, inputs, kernel].map(|size| size as usize);
        let rows = numbers(&weight.permute([2, 3, 1, 0]).reshape([-1, outputs as i64]));
        let lanes = level().width();
        let mut weights = Vec::new();
        for (first, width) in panels(outputs, lanes) {
            let taken = width.min(outputs - first);
            for row in rows.chunks_exact(outputs) {
                weights.extend_from_slice(&row[first..first + taken]);
                weights.resize(weights.len() + width - taken, 0.0);
            }
        }
        let mut bias = bias.map_or_else(|| vec![0.0; outputs], numbers);
        bias.resize(outputs.next_multiple_of(lanes), 0.0);
        let [stride, padding] = [stride, padding].map(|size| size as usize);
        Self { weights, bias, kernel, inputs, outputs, stride, padding }
    }

    /// The shape of its outputs for images of `side` pixels.
    pub(super) fn side(&self, side: usize) -> usize {
        (side + 2 * self.padding - self.kernel) / self.stride + 1
    }

    /// Multiply-accumulates for an image of `side` output pixels.
    pub(super) fn macs(&self, side: usize) -> usize {
        side * side * self.outputs * self.inputs * self.kernel * self.kernel
    }

    /// Products in a sum.
    fn depth(&self) -> usize {
        self.kernel * self.kernel * self.inputs
    }

    /// Whether its weights should be read once for many images.
    pub(super) fn is_heavy(&self) -> bool {
        4 * self.weights.len() > HEAVY
    }

    /// Convolves `images` of shape `from` into images whose pixels lie at `to`, `side` pixels each way.
    pub(super) fn apply(
        &self,
        images: usize,
        input: &[f32],
        from: Shape,
        output: &mut [f32],
        to: Strides,
    ) {
        assert_eq!(from.channels, self.inputs, "the input has the channels of the kernel");
        let border = from.border - self.padding;
        let strides = Strides {
            start: (border * from.row()) + border * from.channels,
            image: from.floats(),
            row: self.stride * from.row(),
            pixel: self.stride * from.channels,
        };
        let side = self.side(from.side);
        if side < images.min(FEW) {
            // A tile's pixels are then those of neighbouring images.
            let turn =
                |at: Strides| Strides { image: at.row, row: at.pixel, pixel: at.image, ..at };
            let (from, to) = ((input, from.row(), turn(strides)), (output, turn(to)));
            self.run(side, (side, images), from, to);
        } else {
            self.run(images, (side, side), (input, from.row(), strides), (output, to));
        }
    }

    fn run(
        &self,
        images: usize,
        (rows, columns): (usize, usize),
        (input, input_row, from): (&[f32], usize, Strides),
        (output, to): (&mut [f32], Strides),
    ) {
        let taps = (self.kernel - 1) * input_row + self.kernel * self.inputs;
        assert!(from.end(images, rows, columns, taps) <= input.len(), "tiles lie in the input");
        assert!(to.end(images, rows, columns, self.outputs) <= output.len(), "and in the output");
        convolve(self, images, (rows, columns), (input, input_row, from), (output, to));
    }
}

/// First channel and width of each panel.
fn panels(outputs: usize, lanes: usize) -> impl Iterator<Item = (usize, usize)> {
    let mut next = 0;
    std::iter::from_fn(move || {
        let first = next;
        let width = if outputs - first.min(outputs) > lanes { 2 * lanes } else { lanes };
        next = first + width;
        (first < outputs).then_some((first, width))
    })
}

/// The numbers of a tensor on the host.
pub(super) fn numbers(x: &Tensor) -> Vec<f32> {
    x.detach().contiguous().view(-1).try_into().expect("parameters are 32-bit floats")
}

versions! {
    fn convolve(
        conv: &Conv,
        images: usize,
        size: (usize, usize),
        input: (&[f32], usize, Strides),
        output: (&mut [f32], Strides),
    ) = convolve_in
}

#[inline(always)]
fn convolve_in<L: Lanes>(
    conv: &Conv,
    images: usize,
    (rows, columns): (usize, usize),
    (input, input_row, from): (&[f32], usize, Strides),
    (output, to): (&mut [f32], Strides),
) {
    // Panels outermost where their weights are what should stay in the cache.
    let (outer, inner) = if conv.is_heavy() { (1, images) } else { (images, 1) };
    for round in 0..outer {
        let row_rounds = if conv.is_heavy() { 1 } else { rows };
        for row_round in 0..row_rounds {
            for (first, width) in panels(conv.outputs, L::WIDTH) {
                for image in round..round + inner {
                    let last = if conv.is_heavy() { rows } else { row_round + 1 };
                    for row in row_round..last {
                        let line = Line {
                            input: &input[from.start + image * from.image + row * from.row..],
                            input_row,
                            input_pixel: from.pixel,
                            runs: conv.kernel,
                            length: conv.kernel * conv.inputs,
                            weights: &conv.weights[first * conv.depth()..][..width * conv.depth()],
                            bias: &conv.bias[first..],
                            output_pixel: to.pixel,
                            channels: width.min(conv.outputs - first),
                        };
                        let start = to.start + image * to.image + row * to.row + first;
                        let output = &mut output[start..];
                        if width == L::WIDTH {
                            line.tiles::<L, 1>(columns, output);
                        } else {
                            line.tiles::<L, 2>(columns, output);
                        }
                    }
                }
            }
        }
    }
}

/// One row of output pixels in one panel of output channels.
struct Line<'a> {
    input: &'a [f32],
    input_row: usize,
    input_pixel: usize,
    /// Rows of the kernel, and what each takes of the input.
    runs: usize,
    length: usize,
    weights: &'a [f32],
    bias: &'a [f32],
    output_pixel: usize,
    channels: usize,
}

impl Line<'_> {
    /// Shares the pixels evenly between tiles.
    #[inline(always)]
    fn tiles<L: Lanes, const N: usize>(&self, columns: usize, output: &mut [f32]) {
        let most = if N == 1 { 12 } else { L::TILE };
        let count = columns.div_ceil(most);
        for tile in 0..count {
            let first = tile * columns / count;
            let pixels = (tile + 1) * columns / count - first;
            macro_rules! of {
                ($($pixels:literal)*) => {
                    match pixels {
                        $($pixels => self.tile::<L, $pixels, N>(first, output),)*
                        _ => unreachable!("tiles have at most 12 pixels"),
                    }
                };
            }
            if N == 2 && L::TILE == 4 {
                of!(1 2 3 4);
            } else if N == 2 && L::TILE == 6 {
                of!(1 2 3 4 5 6);
            } else {
                of!(1 2 3 4 5 6 7 8 9 10 11 12);
            }
        }
    }

    #[inline(always)]
    #[expect(clippy::needless_range_loop, reason = "numbers of lanes and pixels, unrolled")]
    #[expect(unsafe_code, reason = "checks in the innermost loop would cost as much as it does")]
    fn tile<L: Lanes, const M: usize, const N: usize>(&self, first: usize, output: &mut [f32]) {
        // SAFETY: `Conv::run` has asserted that the last tile of the last image lies within the input; weights and
        // bias have whole vectors; what is stored is asserted here.
        unsafe {
            let mut sums = [[L::splat(0.0); N]; M];
            for n in 0..N {
                let bias = L::load(self.bias.as_ptr().add(n * L::WIDTH));
                for sum in &mut sums {
                    sum[n] = bias;
                }
            }
            let mut weights = self.weights.as_ptr();
            let pixels = self.input.as_ptr().add(first * self.input_pixel);
            for run in 0..self.runs {
                let mut pixel = pixels.add(run * self.input_row);
                for _ in 0..self.length {
                    let mut row = [L::splat(0.0); N];
                    for n in 0..N {
                        row[n] = L::load(weights.add(n * L::WIDTH));
                    }
                    for m in 0..M {
                        let x = L::splat(*pixel.add(m * self.input_pixel));
                        for n in 0..N {
                            sums[m][n] = L::multiply_add(x, row[n], sums[m][n]);
                        }
                    }
                    weights = weights.add(N * L::WIDTH);
                    pixel = pixel.add(1);
                }
            }
            for (m, sums) in sums.iter().enumerate() {
                let output = &mut output[(first + m) * self.output_pixel..][..self.channels];
                if self.channels == N * L::WIDTH {
                    for n in 0..N {
                        L::store(output.as_mut_ptr().add(n * L::WIDTH), sums[n]);
                    }
                } else {
                    let mut whole = [0.0; 32];
                    for n in 0..N {
                        L::store(whole.as_mut_ptr().add(n * L::WIDTH), sums[n]);
                    }
                    output.copy_from_slice(&whole[..output.len()]);
                }
            }
        }
    }
}
