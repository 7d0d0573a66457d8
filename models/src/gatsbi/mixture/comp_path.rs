//! Component latents: posterior from the masked frame, prior from the mask latents (mixture spec 2.3, lines 9
//! and 10 of 3). All slots run as one batch.

use tch::Tensor;

use super::{comp_decoder::comp_norm, mask_path::MAX_SCALE, residual::ResidualUpdate};
use crate::{
    config::MixtureConfig,
    kernels::{After, Curve, Layer, Stack},
    nn::{Activation, Conv2d, ConvNorm, ConvShape, Linear, Mlp, Normal, Path},
};

/// Added to masks under the logarithm that the component encoder sees.
const MASK_EPS: f64 = 1e-5;

/// Networks of the component latents.
#[derive(Debug)]
pub(crate) struct CompPath {
    encoder: CompEncoder,
    history: Mlp,
    post_head: Mlp,
    prior_head: Mlp,
    residual: ResidualUpdate,
    prior_action: bool,
}

/// Component latents of one step.
#[derive(Debug)]
pub(crate) struct Components {
    /// Latents after the residual update, `[B, K, z_comp]`.
    pub(crate) z: Tensor,
    /// Distribution of the raw latents, `[B, K, z_comp]`.
    pub(crate) raw: Normal,
    /// `Δ MLP_res`, `[B, K, z_comp]`.
    pub(crate) residual: Tensor,
}

impl CompPath {
    pub(crate) fn new(
        path: &Path<'_>,
        config: &MixtureConfig,
        action: i64,
        image_size: i64,
    ) -> Self {
        let scheme = config.init;
        let (z, h, width) = (config.z_comp, config.hidden, config.mlp);
        let history = [config.comp_encoder.features + h, width, width, width];
        let post = [width + action, width, width, 2 * z];
        let prior_action = if config.comp_prior_action { action } else { 0 };
        let prior = [config.z_mask + z + h + prior_action, width, width, 2 * z];
        Self {
            encoder: CompEncoder::new(&path.sub("encoder"), config, image_size),
            history: Mlp::new(&path.sub("history"), &history, scheme),
            post_head: Mlp::distribution(&path.sub("post_head"), &post, Activation::Celu, scheme),
            prior_head: Mlp::distribution(&path.sub("prior_head"), &prior, Activation::Elu, scheme),
            residual: ResidualUpdate::new(&path.sub("residual"), config, z),
            prior_action: config.comp_prior_action,
        }
    }

    /// Latents given the frame and the masks.
    ///
    /// # Shapes
    /// `frame [B, 3, H, W]`, `log_masks [B, K, 1, H, W]`, `h_post [B, K, h]`, `action [B, ā]`,
    /// `z_previous [B, K, z]`, `first [B, 1, 1]`, `noise [B, K, z]`.
    #[expect(clippy::too_many_arguments, reason = "the conditions of the paper's distribution")]
    pub(crate) fn posterior(
        &self,
        frame: &Tensor,
        log_masks: &Tensor,
        h_post: &Tensor,
        action: &Tensor,
        z_previous: &Tensor,
        first: &Tensor,
        noise: &Tensor,
        train: bool,
    ) -> Components {
        let features = self.encoder.forward(frame, log_masks, train); // [B, K, features]
        let history = self.history.forward(&Tensor::cat(&[&features, h_post], -1));
        let action = per_slot(action, h_post.size()[1]);
        let raw = self.post_head.forward(&Tensor::cat(&[history, action], -1));
        self.draw(&raw, z_previous, first, noise)
    }

    /// Distribution of the raw latents given the past and the mask latents, `[B, K, z_comp]`.
    pub(crate) fn prior_distribution(
        &self,
        z_mask: &Tensor,
        z_previous: &Tensor,
        h_prior: &Tensor,
        action: &Tensor,
    ) -> Normal {
        Normal::from_head(&self.prior_outputs(z_mask, z_previous, h_prior, action))
            .clamp_scale(MAX_SCALE)
    }

    /// Latents given the past and the mask latents.
    pub(crate) fn prior(
        &self,
        z_mask: &Tensor,
        z_previous: &Tensor,
        h_prior: &Tensor,
        action: &Tensor,
        first: &Tensor,
        noise: &Tensor,
    ) -> Components {
        let raw = self.prior_outputs(z_mask, z_previous, h_prior, action);
        self.draw(&raw, z_previous, first, noise)
    }

    fn prior_outputs(
        &self,
        z_mask: &Tensor,
        z_previous: &Tensor,
        h_prior: &Tensor,
        action: &Tensor,
    ) -> Tensor {
        let mut input =
            vec![z_mask.shallow_clone(), z_previous.shallow_clone(), h_prior.shallow_clone()];
        if self.prior_action {
            input.push(per_slot(action, h_prior.size()[1]));
        }
        self.prior_head.forward(&Tensor::cat(&input, -1))
    }

    fn draw(
        &self,
        raw: &Tensor,
        z_previous: &Tensor,
        first: &Tensor,
        noise: &Tensor,
    ) -> Components {
        let raw = Normal::from_head(raw).clamp_scale(MAX_SCALE);
        let (z, residual) = self.residual.forward(&raw.sample(noise), z_previous, first);
        Components { z, raw, residual }
    }

    pub(crate) fn freeze(&mut self) {
        self.encoder.freeze();
    }
}

/// An action `[B, ā]` repeated for every slot, `[B, K, ā]`.
fn per_slot(action: &Tensor, slots: i64) -> Tensor {
    action.unsqueeze(1).expand([-1, slots, -1], false)
}

/// ENC_COMP: the frame and one slot's log mask to features.
#[derive(Debug)]
struct CompEncoder {
    convs: Vec<ConvNorm>,
    output: Linear,
    image_size: i64,
    frozen: Option<Stack>,
}

impl CompEncoder {
    fn new(path: &Path<'_>, config: &MixtureConfig, image_size: i64) -> Self {
        let encoder = &config.comp_encoder;
        let mut inputs = 4;
        let mut convs = Vec::new();
        for (i, &channels) in encoder.channels.iter().enumerate() {
            let shape = ConvShape::halving(inputs, channels, 3);
            let conv = Conv2d::new(&path.sub("conv").sub(i), shape, config.init);
            let norm = comp_norm(&path.sub("norm").sub(i), config.comp_norm, channels);
            convs.push(ConvNorm::new(conv, norm));
            inputs = channels;
        }
        let side = image_size >> encoder.channels.len();
        let inputs = inputs * side * side;
        let output = Linear::new(&path.sub("output"), inputs, encoder.features, config.init);
        Self { convs, output, image_size, frozen: None }
    }

    fn forward(&self, frame: &Tensor, log_masks: &Tensor, train: bool) -> Tensor {
        let (batch, slots) = (log_masks.size()[0], log_masks.size()[1]);
        let masks = (log_masks.exp() + MASK_EPS).log();
        let frames = frame.unsqueeze(1).expand([-1, slots, -1, -1, -1], false);
        let input = Tensor::cat(&[frames, masks], 2).flatten(0, 1); // [B K, 4, H, W]
        let features = match &self.frozen {
            Some(stack) => stack.forward(&input),
            None => self
                .convs
                .iter()
                .fold(input, |x, layer| Activation::Elu.apply(&layer.forward(&x, train))),
        };
        self.output.forward(&features.flatten(1, -1)).view([batch, slots, -1])
    }

    fn freeze(&mut self) {
        for layer in &mut self.convs {
            layer.freeze();
        }
        let layer = |layer: &ConvNorm| Some(Layer::Conv(layer.kernel()?, After::only(Curve::Elu)));
        let layers: Option<Vec<Layer>> = self.convs.iter().map(layer).collect();
        self.frozen =
            layers.and_then(|layers| Stack::for_cpu(layers, self.image_size, &self.output.weight));
    }
}
