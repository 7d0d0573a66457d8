//! What a CPU computes when a model is frozen: convolutional networks in the order that caches like.
//!
//! libtorch runs a network layer by layer over the whole batch, and what does not fit into a cache goes to memory and
//! back at every step. Here an image passes through as many layers as it can ([`stack`]) while it stays in the cache;
//! layers whose weights are larger than images are computed for some images at once. [`conv`] is the convolution,
//! [`map`] activation and normalisation, [`mixing`] what lies between the mixture's decoders and its image, [`glimpses`]
//! the crops of objects.
//!
//! Images do not touch each other, all products are fused and sums have a fixed order, so an image's numbers are the
//! same bytes whatever is computed beside it. What these kernels do not do: gradients, other devices, other number types.

#![expect(
    clippy::inline_always,
    reason = "what is not inlined lacks the instructions of its caller"
)]

mod conv;
mod glimpses;
mod lanes;
mod map;
mod math;
mod mixing;
mod parallel;
mod stack;
mod tensor;

pub(crate) use conv::Conv;
pub(crate) use glimpses::crop;
pub(crate) use map::{After, Curve, Groups};
pub(crate) use mixing::{break_sticks, enlarge_to, mix};
pub(crate) use stack::{Layer, Stack};
