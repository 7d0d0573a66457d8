//! Networks of convolutions: which images pass through which layers together.

use std::sync::{Mutex, PoisonError};

use tch::{Device, Tensor};

use super::{
    conv::{Conv, Strides, numbers},
    map::{After, Curve, Shape, add_and_rectify, spread},
    parallel::for_runs,
    tensor,
};
use crate::nn::macs;

/// Images that pass through heavy layers together.
const TOGETHER: usize = 16;

/// A layer of a [`Stack`].
#[derive(Debug)]
pub(crate) enum Layer {
    /// A convolution.
    Conv(Conv, After),
    /// A 1x1 convolution whose outputs become `factor x factor` pixels, one convolution for each.
    Enlarge {
        /// In row-major order of the pixels.
        parts: Vec<Conv>,
        /// How much larger the image gets.
        factor: usize,
        /// What follows.
        after: After,
    },
    /// ELU of a fixed image plus the input, one vector for all pixels.
    Spread {
        /// `[side, side, channels]`.
        map: Vec<f32>,
        /// Side of the image.
        side: usize,
    },
    /// Two convolutions around a shortcut, rectified.
    Residual {
        /// Rectified.
        first: Conv,
        /// Added to the shortcut.
        second: Conv,
        /// The input itself if there is none.
        shortcut: Option<Conv>,
    },
}

impl Layer {
    /// From `weight [out * factor², in, 1, 1]` and its bias, with channels in the order of a pixel shuffle.
    pub(crate) fn enlarge(
        weight: &Tensor,
        bias: Option<&Tensor>,
        factor: i64,
        after: After,
    ) -> Self {
        let parts = (0..factor * factor).map(|part| {
            let pick = |x: &Tensor| x.unflatten(0, [-1, factor * factor]).select(1, part);
            Conv::new(&pick(weight), bias.map(pick).as_ref(), 1, 0)
        });
        Self::Enlarge { parts: parts.collect(), factor: factor as usize, after }
    }

    /// From a map `[channels, side, side]`.
    pub(crate) fn spread(map: &Tensor) -> Self {
        let side = map.size()[1] as usize;
        Self::Spread { map: numbers(&map.permute([1, 2, 0])), side }
    }

    fn inputs(&self) -> usize {
        match self {
            Self::Conv(conv, _) | Self::Residual { first: conv, .. } => conv.inputs,
            Self::Enlarge { parts, .. } => parts[0].inputs,
            Self::Spread { map, side } => map.len() / (side * side),
        }
    }

    /// Side and channels of its output.
    fn output(&self, side: usize, channels: usize) -> (usize, usize) {
        match self {
            Self::Conv(conv, _) => (conv.side(side), conv.outputs),
            Self::Enlarge { parts, factor, .. } => (side * factor, parts[0].outputs),
            Self::Spread { side, .. } => (*side, channels),
            Self::Residual { first, .. } => (first.side(side), first.outputs),
        }
    }

    /// How far it reaches beyond the edge of its input.
    fn reach(&self) -> usize {
        match self {
            Self::Conv(conv, _) => conv.padding,
            Self::Enlarge { .. } | Self::Spread { .. } => 0,
            Self::Residual { first, .. } => first.padding,
        }
    }

    fn is_heavy(&self) -> bool {
        match self {
            Self::Conv(conv, _) => conv.is_heavy(),
            Self::Enlarge { parts, .. } => {
                parts.len() * parts[0].outputs * parts[0].inputs > 1 << 16
            }
            Self::Spread { .. } => false,
            Self::Residual { second, .. } => second.is_heavy(),
        }
    }

    fn macs(&self, side: usize) -> usize {
        match self {
            Self::Conv(conv, _) => conv.macs(conv.side(side)),
            Self::Enlarge { parts, .. } => parts.iter().map(|part| part.macs(side)).sum(),
            Self::Spread { .. } => 0,
            Self::Residual { first, second, shortcut } => {
                let side = first.side(side);
                let all = [Some(first), Some(second), shortcut.as_ref()];
                all.into_iter().flatten().map(|conv| conv.macs(side)).sum()
            }
        }
    }

    /// Numbers that it needs meanwhile for each image.
    fn room(&self, side: usize) -> usize {
        match self {
            Self::Residual { .. } => self.between(side).floats() + self.beside(side).floats(),
            _ => 0,
        }
    }

    fn apply(
        &self,
        images: usize,
        (input, from): (&[f32], Shape),
        (output, to): (&mut [f32], Shape),
        room: &mut [f32],
    ) {
        let each = |output: &mut [f32], after: &After| {
            for image in output.chunks_exact_mut(to.floats()).take(images) {
                after.apply(image, to);
            }
        };
        match self {
            Self::Conv(conv, after) => {
                conv.apply(images, input, from, output, to.strides());
                each(output, after);
            }
            Self::Enlarge { parts, factor, after } => {
                let Strides { start, image, row, pixel } = to.strides();
                for (part, conv) in parts.iter().enumerate() {
                    let start = start + part / factor * row + part % factor * pixel;
                    let to = Strides { start, image, row: row * factor, pixel: pixel * factor };
                    conv.apply(images, input, from, output, to);
                }
                each(output, after);
            }
            Self::Spread { map, .. } => {
                let vectors = input.chunks_exact(from.floats());
                for (image, vector) in
                    output.chunks_exact_mut(to.floats()).zip(vectors).take(images)
                {
                    spread(map, vector, image, to);
                }
            }
            Self::Residual { first, second, shortcut } => {
                let (between, beside) = (self.between(from.side), self.beside(from.side));
                // Where the parts lie must not depend on how many images there are: borders stay zero from call to call.
                let most = room.len() / (between.floats() + beside.floats());
                let (middle, side) = room.split_at_mut(most * between.floats());
                let rectify = After::only(Curve::Relu);
                first.apply(images, input, from, middle, between.strides());
                for image in middle.chunks_exact_mut(between.floats()).take(images) {
                    rectify.apply(image, between);
                }
                second.apply(images, middle, between, output, to.strides());
                let (other, shape) = match shortcut {
                    Some(conv) => {
                        conv.apply(images, input, from, side, beside.strides());
                        (&*side, beside)
                    }
                    None => (input, from),
                };
                let others = other.chunks_exact(shape.floats());
                for (image, other) in output.chunks_exact_mut(to.floats()).zip(others).take(images)
                {
                    add_and_rectify(image, to, other, shape);
                }
            }
        }
    }

    /// Between the convolutions of a residual layer.
    fn between(&self, side: usize) -> Shape {
        let Self::Residual { first, second, .. } = self else { unreachable!("only there") };
        Shape { side: first.side(side), channels: first.outputs, border: second.padding }
    }

    /// What the shortcut's convolution gives.
    fn beside(&self, side: usize) -> Shape {
        Shape { border: 0, ..self.between(side) }
    }
}

/// Layers one after another.
#[derive(Debug)]
pub(crate) struct Stack {
    layers: Vec<Layer>,
    /// Before each layer and at the end.
    shapes: Vec<Shape>,
    /// Runs of layers that images pass one by one; heavy layers are runs of their own.
    runs: Vec<std::ops::Range<usize>>,
    macs: usize,
    /// Memory of calls before, to be used again.
    rooms: Mutex<Vec<Rooms>>,
}

/// Memory of a call.
#[derive(Debug)]
struct Rooms {
    /// An image, or [`TOGETHER`] images where heavy layers begin or end, of each shape.
    images: Vec<Vec<f32>>,
    /// What each layer needs meanwhile.
    within: Vec<Vec<f32>>,
}

impl Stack {
    /// For images of `side` pixels; vectors are images of one pixel. `None` unless the `weights` of the network, or of
    /// a part, lie on the CPU.
    pub(crate) fn for_cpu(layers: Vec<Layer>, side: i64, weights: &Tensor) -> Option<Self> {
        (weights.device() == Device::Cpu).then(|| Self::new(layers, side))
    }

    fn new(layers: Vec<Layer>, side: i64) -> Self {
        let (mut side, mut channels) = (side as usize, layers[0].inputs());
        let (mut shapes, mut runs, mut macs) = (Vec::new(), Vec::new(), 0);
        let mut after_heavy = true;
        for (i, layer) in layers.iter().enumerate() {
            shapes.push(Shape { side, channels, border: layer.reach() });
            macs += layer.macs(side);
            (side, channels) = layer.output(side, channels);
            match runs.last_mut() {
                Some(std::ops::Range { end, .. }) if !layer.is_heavy() && !after_heavy => {
                    *end = i + 1;
                }
                _ => runs.push(i..i + 1),
            }
            after_heavy = layer.is_heavy();
        }
        shapes.push(Shape { side, channels, border: 0 });
        Self { layers, shapes, runs, macs, rooms: Mutex::default() }
    }

    /// # Shapes
    /// `[N, channels, side, side]` or, for vectors, `[N, channels]`; returns `[N, channels', side', side']`.
    pub(crate) fn forward(&self, x: &Tensor) -> Tensor {
        let images = x.size()[0];
        let x = x.contiguous();
        let [first, last] = [self.shapes[0], self.shapes[self.layers.len()]];
        let size = |shape: Shape| shape.side * shape.side * shape.channels;
        let side = last.side as i64;
        let mut output = tensor::room(&[images, last.channels as i64, side, side]);
        let input = tensor::numbers(&x);
        let output_image = size(last);
        let output_numbers = tensor::numbers_mut(&mut output);
        let computed =
            for_runs(images as usize, TOGETHER, (output_numbers, output_image), |start, output| {
                let pool = || self.rooms.lock().unwrap_or_else(PoisonError::into_inner);
                let taken = pool().pop();
                let mut rooms = taken.unwrap_or_else(|| self.rooms());
                let images = output.len() / output_image;
                self.run(images, &input[start * size(first)..], output, &mut rooms);
                pool().push(rooms);
            });
        macs::add(computed * self.macs);
        output
    }

    fn rooms(&self) -> Rooms {
        let last = self.runs.len() - 1;
        let joint = |at: usize| {
            let heavy = |run: &std::ops::Range<usize>| self.layers[run.start].is_heavy();
            let inner = |(i, run): (usize, &std::ops::Range<usize>)| {
                run.start == at && (i > 0 || heavy(run))
                    || run.end == at && (i < last || heavy(run))
            };
            self.runs.iter().enumerate().any(inner)
        };
        let count = |at: usize| if joint(at) { TOGETHER } else { 1 };
        let images = self.shapes.iter().enumerate();
        let within = self.layers.iter().zip(&self.shapes);
        Rooms {
            images: images.map(|(at, shape)| vec![0.0; count(at) * shape.floats()]).collect(),
            within: within
                .map(|(layer, shape)| {
                    let count = if layer.is_heavy() { TOGETHER } else { 1 };
                    vec![0.0; count * layer.room(shape.side)]
                })
                .collect(),
        }
    }

    fn run(&self, images: usize, input: &[f32], output: &mut [f32], rooms: &mut Rooms) {
        let end = self.layers.len();
        for run in &self.runs {
            let heavy = self.layers[run.start].is_heavy();
            let (rounds, together) = if heavy { (1, images) } else { (images, 1) };
            for round in 0..rounds {
                // An image's place in memory that holds one image is the first, in that of many its own.
                let place = |room: &[f32], shape: Shape| {
                    if room.len() == shape.floats() { 0 } else { round * shape.floats() }
                };
                if run.start == 0 {
                    let (shape, room) = (self.shapes[0], &mut rooms.images[0]);
                    for image in round..round + together {
                        let at = place(room, shape) + (image - round) * shape.floats();
                        bring_in(input, image, shape, &mut room[at..]);
                    }
                }
                for at in run.clone() {
                    let (before, after) = rooms.images.split_at_mut(at + 1);
                    let (input, from) = (&before[at], self.shapes[at]);
                    let (output, to) = (&mut after[0], self.shapes[at + 1]);
                    let (read, write) = (place(input, from), place(output, to));
                    let (input, output) = (&input[read..], &mut output[write..]);
                    self.layers[at].apply(
                        together,
                        (input, from),
                        (output, to),
                        &mut rooms.within[at],
                    );
                }
                if run.end == end {
                    let (shape, room) = (self.shapes[end], &rooms.images[end]);
                    for image in round..round + together {
                        let at = place(room, shape) + (image - round) * shape.floats();
                        bring_out(&room[at..], shape, output, image);
                    }
                }
            }
        }
    }
}

/// Image number `image` of `[N, C, H, W]` into memory of `shape`.
fn bring_in(images: &[f32], image: usize, shape: Shape, room: &mut [f32]) {
    let Shape { side, channels, .. } = shape;
    let planes = &images[image * side * side * channels..][..side * side * channels];
    let Strides { start, row, .. } = shape.strides();
    for (channel, plane) in planes.chunks_exact(side * side).enumerate() {
        for (line, out) in plane.chunks_exact(side).zip(room[start..].chunks_mut(row)) {
            for (x, pixel) in line.iter().zip(out.chunks_exact_mut(channels)) {
                pixel[channel] = *x;
            }
        }
    }
}

/// Memory of `shape`, which has no border, to image number `image` of `[N, C, H, W]`.
fn bring_out(room: &[f32], shape: Shape, images: &mut [f32], image: usize) {
    let Shape { side, channels, .. } = shape;
    let planes = &mut images[image * side * side * channels..][..side * side * channels];
    for (channel, plane) in planes.chunks_exact_mut(side * side).enumerate() {
        for (x, pixel) in plane.iter_mut().zip(room.chunks_exact(channels)) {
            *x = pixel[channel];
        }
    }
}
