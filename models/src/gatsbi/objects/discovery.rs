//! Discovery: new objects from a frame, one candidate per grid cell (object spec 3.4).

use tch::{Kind, Tensor};

use super::{
    ObjectKl,
    image_encoder::ImageEncoder,
    latents::{Latents, Layout, place, presence, shift},
    sum_per_row,
};
use crate::{
    config::{DiscoveryPrior, ObjectConfig},
    nn::{
        Activation, Conv2d, ConvShape, GroupNorm, InitScheme, Mlp, Normal, Path,
        distributions::{kl_bernoulli, positive, relaxed_bernoulli},
        linear,
        spatial_transformer::{iou, pixel_centres},
    },
    noise::{Noise, Site},
};

/// Networks of discovery.
#[derive(Debug)]
pub(crate) struct Discovery {
    pub(super) image_encoder: ImageEncoder,
    map: Mlp,
    dyna_head: CellHead,
    attribute_head: CellHead,
    layout: Layout,
    grid: i64,
    map_sigma: f64,
}

/// Candidates of one frame, G² per row in row-major order of the cells.
#[derive(Debug)]
pub(crate) struct Discovered {
    /// Latents; those that were rejected are absent, `[B, G², Z]`.
    pub(crate) z: Tensor,
    /// Posteriors of the cells.
    pub(crate) posterior: CellPosterior,
    /// Sampled presence before rejection, `[B, G², 1]`.
    pub(crate) presence: Tensor,
}

/// Posterior distributions of the cells.
#[derive(Debug)]
pub(crate) struct CellPosterior {
    /// Probability of an object, `[B, G², 1]`.
    pub(crate) presence: Tensor,
    /// Depth, `[B, G², 1]`.
    pub(crate) depth: Normal,
    /// Raw where (before sigmoid and tanh), `[B, G², 4]`.
    pub(crate) raw_place: Normal,
    /// What, `[B, G², what]`.
    pub(crate) what: Normal,
    /// Dynamics, `[B, G², dyna]`.
    pub(crate) dyna: Normal,
}

impl Discovery {
    pub(crate) fn new(
        path: &Path<'_>,
        config: &ObjectConfig,
        layout: Layout,
        image_size: i64,
    ) -> Self {
        let hidden = config.hidden;
        let map = [layout.width(), hidden, hidden, hidden];
        // G-SWM's attribute head also has outputs for the dynamics latent that nothing reads.
        let attributes = 11 + 2 * layout.what + 2 * layout.dyna;
        Self {
            image_encoder: ImageEncoder::new(&path.sub("img_encoder"), config, image_size),
            map: Mlp::new(&path.sub("prop_map_mlp"), &map, InitScheme::Framework),
            dyna_head: CellHead::new(&path.sub("latent_post_disc"), hidden, 2 * layout.dyna),
            attribute_head: CellHead::new(
                &path.sub("pres_depth_where_what_latent_post_disc"),
                hidden,
                attributes,
            ),
            layout,
            grid: config.grid,
            map_sigma: config.updates.map_sigma,
        }
    }

    /// # Shapes
    /// `input [B, 6, H, W]` is [`input`], `propagated [B, N, Z]`.
    pub(crate) fn posterior(
        &self,
        input: &Tensor,
        propagated: &Tensor,
        noise: &dyn Noise,
        train: bool,
    ) -> Discovered {
        let features = self.image_encoder.forward(input, train);
        let map = self.propagation_map(propagated);
        let posterior = self.heads(&Tensor::cat(&[&features, &map], 1));
        let draw = |normal: &Normal, site| normal.sample(&noise.normal(site, &normal.loc.size()));
        let uniform = noise.uniform(Site::DiscoveryPresence, &posterior.presence.size());
        let presence = relaxed_bernoulli(&posterior.presence, &uniform, 1.0);
        let place = self.absolute(&draw(&posterior.raw_place, Site::DiscoveryWhere));
        let latents = Latents {
            pres: presence.shallow_clone(),
            depth: draw(&posterior.depth, Site::DiscoveryDepth),
            place,
            what: draw(&posterior.what, Site::DiscoveryWhat),
            dyna: draw(&posterior.dyna, Site::DiscoveryDynamics),
        };
        Discovered { z: latents.join(), posterior, presence }
    }

    /// Where the propagated objects are, as features of the grid, `[B, hidden, G, G]`.
    pub(crate) fn propagation_map(&self, z: &Tensor) -> Tensor {
        let batch = z.size()[0];
        let centres = self.cell_centres(z); // [G², 2]
        let distance = (centres.unsqueeze(0).unsqueeze(2) - shift(z).unsqueeze(1)).square(); // [B, G², N, 2]
        let variance = self.map_sigma * self.map_sigma;
        let squared = distance.sum_dim_intlist(-1, false, Kind::Float);
        let density = (squared * (-0.5 / variance)).exp() / (std::f64::consts::TAU * variance);
        let weight = density * presence(z).transpose(1, 2); // [B, G², N]
        let map = weight.matmul(&self.map.forward(z)); // [B, G², hidden]
        map.transpose(1, 2).reshape([batch, -1, self.grid, self.grid])
    }

    /// Posteriors of the cells given `[features, map]`, `[B, 2 hidden, G, G]`.
    pub(crate) fn heads(&self, input: &Tensor) -> CellPosterior {
        let Layout { what, .. } = self.layout;
        let dyna = Normal::from_head(&self.dyna_head.forward(input, None));
        let outputs = self.attribute_head.forward(input, Some(11 + 2 * what));
        let normal = |start: i64, width: i64| Normal {
            loc: outputs.narrow(-1, start, width),
            scale: positive(&outputs.narrow(-1, start + width, width)),
        };
        CellPosterior {
            presence: outputs.narrow(-1, 0, 1).sigmoid(),
            depth: normal(1, 1),
            raw_place: normal(3, 4),
            what: normal(11, what),
            dyna,
        }
    }

    /// Raw to absolute `z_where` (object spec 4.3), `[B, G², 4]`.
    pub(crate) fn absolute(&self, raw: &Tensor) -> Tensor {
        let scale = raw.narrow(-1, 0, 2).sigmoid();
        let shift = raw.narrow(-1, 2, 2).tanh() * (2.0 / self.grid as f64) + self.cell_centres(raw);
        Tensor::cat(&[scale, shift], -1)
    }

    /// Centres (x, y) of the cells in row-major order, `[G², 2]`.
    pub(crate) fn cell_centres(&self, like: &Tensor) -> Tensor {
        let line = pixel_centres(self.grid, like);
        let shape = [self.grid, self.grid];
        let x = line.unsqueeze(0).expand(shape, false);
        let y = line.unsqueeze(1).expand(shape, false);
        Tensor::stack(&[x, y], -1).view([-1, 2])
    }

    pub(crate) fn freeze(&mut self) {
        self.image_encoder.freeze();
    }
}

/// What discovery sees: a frame `[B, 3, H, W]` and its difference to `mu_mix`, `[B, 6, H, W]`.
pub(crate) fn input(frame: &Tensor, mu_mix: &Tensor) -> Tensor {
    Tensor::cat(&[frame, &(frame - mu_mix)], 1)
}

/// Which known objects are present and overlap a candidate at `z_where [B, G², 4]` more than `threshold`, `[B, G², N]` bool.
pub(crate) fn overlapped(z_where: &Tensor, known: &Tensor, threshold: f64) -> Tensor {
    let overlap = iou(&z_where.detach(), &place(known).detach());
    let present = presence(known).gt(0.5).transpose(1, 2); // [B, 1, N]
    overlap.gt(threshold).logical_and(&present)
}

impl Discovered {
    /// KL terms per row (object spec 3.4, step 8); `active [B, 1, 1]` is 0 on rows without discovery.
    pub(crate) fn kl(&self, active: &Tensor, prior: &DiscoveryPrior) -> ObjectKl {
        let posterior = &self.posterior;
        let device = self.z.device();
        let vector = |scale: f64, shift: f64| {
            Tensor::from_slice(&[scale, scale, shift, shift]).to_kind(Kind::Float).to_device(device)
        };
        let (loc, std) =
            (vector(prior.scale_mean, prior.shift_mean), vector(prior.scale_std, prior.shift_std));
        let present = &self.presence;
        let sum = |x: Tensor| sum_per_row(&(x * active));
        ObjectKl {
            pres: sum(kl_bernoulli(&posterior.presence, prior.presence)),
            depth: sum(posterior.depth.kl_to_standard() * present),
            place: sum(posterior.raw_place.kl_to(&loc, &std) * present),
            what: sum(posterior.what.kl_to_standard() * present),
            dyna: sum(posterior.dyna.kl_to_standard()),
        }
    }

    /// `z_where` of the candidates, `[B, G², 4]`.
    pub(crate) fn place(&self) -> Tensor {
        place(&self.z)
    }
}

/// 1x1 convolutions with CELU and group norm to the outputs of each cell (object spec 2.2).
#[derive(Debug)]
struct CellHead {
    trunk: [(Conv2d, GroupNorm); 2],
    output: Conv2d,
}

impl CellHead {
    fn new(path: &Path<'_>, hidden: i64, outputs: i64) -> Self {
        let path = path.sub("enc");
        let conv = |index: i64, inputs, outputs| {
            let shape = ConvShape::same(inputs, outputs, 1);
            Conv2d::new(&path.sub(index), shape, InitScheme::Framework)
        };
        let norm = |index: i64| GroupNorm::new(&path.sub(index), 8, hidden);
        Self {
            trunk: [(conv(0, 2 * hidden, hidden), norm(2)), (conv(3, hidden, hidden), norm(5))],
            output: conv(6, hidden, outputs),
        }
    }

    /// `[B, 2 hidden, G, G]` to the first `outputs` (or all) outputs per cell, `[B, G², outputs]`.
    fn forward(&self, x: &Tensor, outputs: Option<i64>) -> Tensor {
        let x = self.trunk.iter().fold(x.shallow_clone(), |x, (conv, norm)| {
            norm.forward(&Activation::Celu.apply(&conv.forward(&x)))
        });
        let (weight, bias) = self.output.as_linear();
        let outputs = outputs.unwrap_or(weight.size()[0]);
        let cells = x.flatten(2, -1).transpose(1, 2); // [B, G², hidden]
        let bias = bias.map(|bias| bias.narrow(0, 0, outputs));
        linear(&cells, &weight.narrow(0, 0, outputs), bias.as_ref())
    }
}
