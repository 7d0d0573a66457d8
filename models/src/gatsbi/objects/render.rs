//! Rendering: objects into the image (object spec 3.7).

use tch::{Kind, Tensor};

use super::{
    glimpse::GlimpseDecoder,
    latents::{Latents, Layout},
};
use crate::nn::spatial_transformer::{pixel_centres, place};

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

/// Where objects are, in units of the image's half side from its centre, and of which colour. A box need not be centred on
/// its object.
#[derive(Debug)]
pub struct Placed {
    /// Presence, `[B, N, 1]`.
    pub presence: Tensor,
    /// Centres of boxes, `[B, N, 2]`.
    pub centre: Tensor,
    /// Centre of what is drawn in a box less the box's own, `[B, N, 2]`. Boxes get no gradient from it.
    pub offset: Tensor,
    /// Mean colour of what is drawn, `[B, N, 3]` in [0, 1].
    pub colour: Tensor,
    /// What is drawn in a box, premultiplied colours and alpha in [0, 1] before presence, `[B, N, 4, s, s]`.
    pub drawn: Tensor,
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

/// How far objects `z [B, N, Z]` whose boxes show `glimpses [B, N, 4, s, s]` cover an image of `side` pixels, `[B, 1, H, W]` in
/// [0, 1].
pub(crate) fn covered(glimpses: &Tensor, z: &Tensor, layout: Layout, side: i64) -> Tensor {
    let Latents { pres, place: z_where, .. } = layout.split(z);
    let alpha = glimpses.narrow(2, 3, 1) * pres.unsqueeze(-1).unsqueeze(-1);
    place(&alpha, &z_where, side).amax(1, false)
}

/// Mean colours of what `glimpses [B, N, 4, s, s]` show, `[B, N, 3]` in [0, 1].
pub(crate) fn colour(glimpses: &Tensor) -> Tensor {
    let alpha = glimpses.narrow(2, 3, 1); // [B, N, 1, s, s]
    let sum = |x: &Tensor| x.sum_dim_intlist([3i64, 4].as_slice(), false, Kind::Float);
    sum(&(glimpses.narrow(2, 0, 3) * &alpha)) / (sum(&alpha) + EPS)
}

/// Where objects `z [B, N, Z]` are.
pub(crate) fn placed(decoder: &GlimpseDecoder, z: &Tensor, layout: Layout) -> Placed {
    let Latents { pres, place, what, .. } = layout.split(z);
    let glimpses = decoder.forward(&what); // [B, N, 4, s, s]
    let alpha = glimpses.select(2, 3); // [B, N, s, s]
    let line = pixel_centres(alpha.size()[3], &alpha);
    let total = alpha.sum_dim_intlist([2i64, 3].as_slice(), false, Kind::Float) + EPS;
    let painted = glimpses.narrow(2, 0, 3) * alpha.unsqueeze(2); // [B, N, 3, s, s]
    let middle = |across: i64| {
        let along = alpha.sum_dim_intlist(across, false, Kind::Float);
        (along * &line).sum_dim_intlist(-1, false, Kind::Float) / &total
    };
    let within = Tensor::stack(&[middle(2), middle(3)], -1);
    Placed {
        colour: colour(&glimpses),
        drawn: Tensor::cat(&[painted, alpha.unsqueeze(2)], 2),
        presence: pres,
        centre: place.narrow(-1, 2, 2),
        offset: within * place.narrow(-1, 0, 2).detach(),
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

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::{config::presets, nn::ParamStore};

    #[test]
    fn the_drawn_centre_is_the_centre_of_the_drawn_alpha() {
        let config = presets::tiny().objects;
        let layout = Layout { what: config.z_what, dyna: config.z_dyna };
        let mut store = ParamStore::new(1, Device::Cpu);
        let decoder = store.build(|root| GlimpseDecoder::new(root, &config));
        let _no_grad = tch::no_grad_guard();
        let box_and_depth = Tensor::from_slice(&[1f32, 0.0, 0.5, 0.25, 0.1, -0.3]);
        let rest = Tensor::randn([config.z_what + config.z_dyna], (Kind::Float, Device::Cpu)) * 3.0;
        let z = Tensor::cat(&[box_and_depth, rest], 0).view([1, 1, -1]);
        let alpha = render(&decoder, &z, layout, 128).alpha.view([128, 128]);
        let line = pixel_centres(128, &alpha);
        let centre = |across: i64| {
            let along = alpha.sum_dim_intlist(across, false, Kind::Float);
            ((along * &line).sum(Kind::Float) / alpha.sum(Kind::Float)).double_value(&[])
        };
        let Placed { centre: box_centre, offset, .. } = placed(&decoder, &z, layout);
        let found = box_centre + offset;
        for (axis, across) in [(0, 0), (1, 1)] {
            let difference = found.double_value(&[0, 0, axis]) - centre(across);
            assert!(difference.abs() < 5e-3, "axis {axis}: {difference}");
        }
    }
}
