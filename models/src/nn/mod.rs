//! Layers: parameters with names and initialisation, and the few building blocks the models are made of.
//!
//! A layer is built from a [`Path`] (which names and creates its parameters) and its sizes, and holds the
//! tensors themselves; forward passes are pure. Exact inference forms (folded batch norm, precomputed
//! constants) are made by `freeze`, after which a layer no longer follows changes of its parameters.

mod conv;
pub(crate) mod distributions;
mod linear;
mod lstm;
pub(crate) mod macs;
mod params;
pub(crate) mod spatial_transformer;

pub use distributions::Normal;
pub use macs::count_macs;
pub use params::{Init, InitScheme, ParamKind, ParamStore, Path};

pub(crate) use conv::{BatchNorm2d, Conv2d, ConvNorm, ConvShape, GroupNorm, Norm, SubPixelConv};
pub(crate) use linear::{Linear, Mlp, linear};
pub(crate) use lstm::{LearnedState, LstmBank, LstmCell};

use tch::Tensor;

/// Hidden activations of the paper's tables.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(crate) enum Activation {
    /// CELU with alpha 1.
    Celu,
    /// ELU with alpha 1.
    Elu,
    /// Leaky `ReLU`; the slope is that of the keypoint networks, 0.2.
    LeakyRelu,
}

impl Activation {
    pub(crate) fn apply(self, x: &Tensor) -> Tensor {
        match self {
            // With alpha 1 the two are the same function.
            Self::Celu | Self::Elu => x.elu(),
            Self::LeakyRelu => x.maximum(&(x * 0.2)),
        }
    }
}
