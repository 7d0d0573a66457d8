//! Rendering: objects into the image (object spec 3.7).

use tch::{Kind, Tensor};

use super::{
    glimpse::GlimpseDecoder,
    latents::{Latents, Layout},
};
use crate::nn::spatial_transformer::place;

/// Keeps the normalisation of importance finite where no object is.
const EPS: f64 = 1e-5;

/// Objects drawn into an image.
#[derive(Debug)]
pub struct Rendering {
    /// Premultiplied foreground, `[B, 3, H, W]`.
    pub foreground: Tensor,
    /// Alpha of all objects together in [0, 1], `[B, 1, H, W]`.
    pub alpha: Tensor,
    /// Share of each object in `alpha`, `[B, N, H, W]`; sums to it.
    pub masks: Tensor,
}

/// Draws objects `z [B, N, Z]` into images of `side` pixels.
pub(crate) fn render(decoder: &GlimpseDecoder, z: &Tensor, layout: Layout, side: i64) -> Rendering {
    let Latents { pres, depth, place: z_where, what, .. } = layout.split(z);
    let glimpses = decoder.forward(&what); // [B, N, 4, s, s]
    let alpha = glimpses.narrow(2, 3, 1) * pres.unsqueeze(-1).unsqueeze(-1);
    let colour = glimpses.narrow(2, 0, 3) * &alpha;
    let placed = place(&Tensor::cat(&[colour, alpha], 2), &z_where, side); // [B, N, 4, H, W]
    let (colour, alpha) = (placed.narrow(2, 0, 3), placed.narrow(2, 3, 1));
    let nearness = (-depth).sigmoid().unsqueeze(-1).unsqueeze(-1);
    let importance = &alpha * nearness;
    let importance = &importance / (importance.sum_dim_intlist(1, true, Kind::Float) + EPS);
    let masks = &importance * alpha; // [B, N, 1, H, W]
    Rendering {
        foreground: (importance * colour).sum_dim_intlist(1, false, Kind::Float),
        alpha: masks.sum_dim_intlist(1, false, Kind::Float),
        masks: masks.squeeze_dim(2),
    }
}

impl Rendering {
    /// The objects' colours without their alpha, `[B, 3, H, W]`; meaningless where `alpha` is 0.
    pub fn colour(&self) -> Tensor {
        &self.foreground / (&self.alpha + EPS)
    }

    /// `mu_t = mu^o + (1 - alpha) mu_mix`, `[B, 3, H, W]`.
    pub fn over(&self, mu_mix: &Tensor) -> Tensor {
        &self.foreground + (1.0 - &self.alpha) * mu_mix
    }
}
