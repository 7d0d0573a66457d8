//! Mask latents: the autoregressive posterior and prior over slots (mixture spec 2.2, lines 2 to 7 of 3).
//!
//! Only here does the order of slots matter: slot k sees slot k-1's latent through an LSTM that restarts every
//! frame, and the action enters at the first slot.

use tch::Tensor;

use super::residual::ResidualUpdate;
use crate::{
    config::MixtureConfig,
    nn::{LearnedState, LstmCell, Mlp, Normal, Path},
};

/// Standard deviations of latents are capped here, so that a diverging prior stays finite.
pub(super) const MAX_SCALE: f64 = 10.0;

/// Networks of the mask latents.
#[derive(Debug)]
pub(crate) struct MaskPath {
    slots: i64,
    post_first: Mlp,
    post_rest: Mlp,
    post_chain: LstmCell,
    post_chain_start: LearnedState,
    post_latent_start: Tensor,
    post_head: Mlp,
    prior_first: Mlp,
    prior_rest: Mlp,
    prior_chain: LstmCell,
    prior_chain_start: LearnedState,
    prior_head: Mlp,
    residual: ResidualUpdate,
}

/// What drives the prior's chain over slots.
pub(crate) enum Drive<'a> {
    /// Latents drawn from the prior itself with this noise `[B, K, z_mask]`: imagining.
    Sample {
        /// Standard normal.
        noise: &'a Tensor,
        /// `[B, 1, 1]` bool, rows whose state is the initial one.
        first: &'a Tensor,
    },
    /// Given latents `[B, K, z_mask]`: the prior's parameters for the KL.
    Given(&'a Tensor),
}

/// Mask latents of one step.
#[derive(Debug)]
pub(crate) struct Masks {
    /// Latents after the residual update, `[B, K, z_mask]`.
    pub(crate) z: Tensor,
    /// Distribution of the raw latents, `[B, K, z_mask]`.
    pub(crate) raw: Normal,
    /// `Δ MLP_res`, `[B, K, z_mask]`; absent where latents were given.
    pub(crate) residual: Option<Tensor>,
}

impl MaskPath {
    pub(crate) fn new(path: &Path<'_>, config: &MixtureConfig, action: i64) -> Self {
        let scheme = config.init;
        let (z, h, e) = (config.z_mask, config.hidden, config.mask_features);
        let mlp = |name: &str, inputs, outputs| {
            Mlp::new(&path.sub(name), &[inputs, config.mlp, config.mlp, outputs], scheme)
        };
        let head = |name: &str, inputs| {
            let widths = [inputs, config.mlp, config.mlp, 2 * z];
            Mlp::distribution(&path.sub(name), &widths, crate::nn::Activation::Celu, scheme)
        };
        Self {
            slots: config.slots,
            post_first: mlp("post_first", config.encoder.features + h + action, e),
            post_rest: mlp("post_rest", config.encoder.features + h, e),
            post_chain: LstmCell::new(&path.sub("post_chain"), e + z, h),
            post_chain_start: LearnedState::new(&path.sub("post_chain_start"), &[h], scheme),
            post_latent_start: path.weight("post_latent_start", &[z], LearnedState::init(scheme)),
            post_head: head("post_head", h),
            prior_first: mlp("prior_first", z + 2 * h + action, e),
            prior_rest: mlp("prior_rest", z + 2 * h, e),
            prior_chain: LstmCell::new(&path.sub("prior_chain"), h + z, h),
            prior_chain_start: LearnedState::new(&path.sub("prior_chain_start"), &[h], scheme),
            prior_head: head("prior_head", e),
            residual: ResidualUpdate::new(&path.sub("residual"), config, z),
        }
    }

    /// Latents given the frame.
    ///
    /// # Shapes
    /// `encoding [B, e]`, `h_post [B, K, h]`, `action [B, ā]`, `z_previous [B, K, z]`, `first [B, 1, 1]`,
    /// `noise [B, K, z]`.
    pub(crate) fn posterior(
        &self,
        encoding: &Tensor,
        h_post: &Tensor,
        action: &Tensor,
        z_previous: &Tensor,
        first: &Tensor,
        noise: &Tensor,
    ) -> Masks {
        let batch = encoding.size()[0];
        let rest = self.slots - 1;
        let first_input = Tensor::cat(&[encoding, &h_post.select(1, 0), action], -1);
        let encodings = encoding.unsqueeze(1).expand([batch, rest, encoding.size()[1]], false);
        let rest_input = Tensor::cat(&[encodings, h_post.narrow(1, 1, rest)], -1); // [B, K-1, e+h]
        let features = Tensor::cat(
            &[
                self.post_first.forward(&first_input).unsqueeze(1),
                self.post_rest.forward(&rest_input),
            ],
            1,
        ); // [B, K, mask_features]

        let (mut h, mut c) = self.post_chain_start.expand(batch);
        let mut z_k = self.post_latent_start.unsqueeze(0).expand([batch, -1], false);
        let mut chain = Collected::default();
        for k in 0..self.slots {
            let input = Tensor::cat(&[&features.select(1, k), &z_k], -1);
            (h, c) = self.post_chain.forward(&input, (&h, &c));
            let raw = Normal::from_head(&self.post_head.forward(&h)).clamp_scale(MAX_SCALE);
            z_k = self.take(&mut chain, k, raw, z_previous, first, noise);
        }
        chain.stack()
    }

    /// Latents, or only their distribution, given the past alone.
    ///
    /// # Shapes
    /// `z_previous [B, K, z]`, `h_prior [B, K, h]`, `action [B, ā]`.
    pub(crate) fn prior(
        &self,
        z_previous: &Tensor,
        h_prior: &Tensor,
        action: &Tensor,
        drive: &Drive<'_>,
    ) -> Masks {
        let batch = z_previous.size()[0];
        let (mut s, mut c) = self.prior_chain_start.expand(batch);
        let mut chain = Collected::default();
        for k in 0..self.slots {
            let (z_k_previous, h_k) = (z_previous.select(1, k), h_prior.select(1, k));
            let features = if k == 0 {
                self.prior_first.forward(&Tensor::cat(&[&z_k_previous, &h_k, &s, action], -1))
            } else {
                self.prior_rest.forward(&Tensor::cat(&[&z_k_previous, &h_k, &s], -1))
            };
            let raw = Normal::from_head(&self.prior_head.forward(&features)).clamp_scale(MAX_SCALE);
            let z_k = match drive {
                Drive::Sample { noise, first } => {
                    self.take(&mut chain, k, raw, z_previous, first, noise)
                }
                Drive::Given(z) => {
                    chain.push_given(raw, z.select(1, k));
                    z.select(1, k)
                }
            };
            if k + 1 < self.slots {
                (s, c) = self.prior_chain.forward(&Tensor::cat(&[&h_k, &z_k], -1), (&s, &c));
            }
        }
        chain.stack()
    }

    /// Draws slot k and applies the residual update.
    fn take(
        &self,
        chain: &mut Collected,
        k: i64,
        raw: Normal,
        z_previous: &Tensor,
        first: &Tensor,
        noise: &Tensor,
    ) -> Tensor {
        let z_bar = raw.sample(&noise.select(1, k));
        let (z_k, residual) =
            self.residual.forward(&z_bar, &z_previous.select(1, k), &first.squeeze_dim(1));
        chain.push(raw, z_k.shallow_clone(), residual);
        z_k
    }
}

/// Per-slot results on their way to being stacked.
#[derive(Default)]
struct Collected {
    z: Vec<Tensor>,
    loc: Vec<Tensor>,
    scale: Vec<Tensor>,
    residual: Vec<Tensor>,
}

impl Collected {
    fn push(&mut self, raw: Normal, z: Tensor, residual: Tensor) {
        self.push_given(raw, z);
        self.residual.push(residual);
    }

    fn push_given(&mut self, raw: Normal, z: Tensor) {
        self.loc.push(raw.loc);
        self.scale.push(raw.scale);
        self.z.push(z);
    }

    fn stack(&self) -> Masks {
        Masks {
            z: Tensor::stack(&self.z, 1),
            raw: Normal { loc: Tensor::stack(&self.loc, 1), scale: Tensor::stack(&self.scale, 1) },
            residual: (!self.residual.is_empty()).then(|| Tensor::stack(&self.residual, 1)),
        }
    }
}
