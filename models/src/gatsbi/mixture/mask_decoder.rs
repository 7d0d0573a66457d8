//! DEC_MASK: latents to mask logits, and the stick breaking that turns logits into masks (mixture spec 2.2).

use tch::Tensor;

use crate::{
    config::{MixtureConfig, SubPixelStage},
    kernels::{self, After, Curve, Layer, Stack},
    nn::{Activation, Conv2d, ConvShape, GroupNorm, InitScheme, Mlp, Path, SubPixelConv},
};

/// Mask logit that decoders start from.
const START_LOGIT: f64 = -2.0;

/// Decodes the first K-1 slots' latents to logits; the last slot takes what they leave.
#[derive(Debug)]
pub(crate) struct MaskDecoder {
    condition: Mlp,
    base: (Conv2d, GroupNorm),
    stages: Vec<Stage>,
    output: Conv2d,
    image_size: i64,
    frozen: Option<Stack>,
}

/// Sub-pixel enlargement, then a 3x3 convolution with CELU and group norm.
#[derive(Debug)]
pub(super) struct Stage {
    enlarge: SubPixelConv,
    conv: Conv2d,
    norm: GroupNorm,
}

impl Stage {
    pub(super) fn new(
        path: &Path<'_>,
        inputs: i64,
        stage: SubPixelStage,
        scheme: InitScheme,
    ) -> Self {
        let SubPixelStage { factor, channels, groups } = stage;
        let shape = ConvShape::same(inputs, channels * factor * factor, 1);
        let enlarge = SubPixelConv::new(
            Conv2d::new(&path.sub("enlarge"), shape, scheme),
            Some(GroupNorm::new(&path.sub("enlarge_norm"), groups, channels)),
            factor,
        );
        let shape = ConvShape::same(channels, channels, 3);
        let conv = Conv2d::new(&path.sub("conv"), shape, scheme);
        Self { enlarge, conv, norm: GroupNorm::new(&path.sub("norm"), groups, channels) }
    }

    pub(super) fn forward(&self, x: &Tensor) -> Tensor {
        let x = self.conv.forward(&self.enlarge.forward(x));
        self.norm.forward(&Activation::Celu.apply(&x))
    }

    /// The same for a CPU.
    pub(super) fn layers(&self) -> [Layer; 2] {
        let enlarge = self.enlarge.kernel().expect("enlargement is followed by a norm");
        [enlarge, Layer::Conv(self.conv.kernel(), self.norm.after_celu())]
    }
}

/// The stages of a decoder under `path.stages`, and the channels that come out.
pub(super) fn stages(
    path: &Path<'_>,
    inputs: i64,
    stages: &[SubPixelStage],
    scheme: InitScheme,
) -> (Vec<Stage>, i64) {
    let path = path.sub("stages");
    let mut inputs = inputs;
    let built = stages
        .iter()
        .enumerate()
        .map(|(i, &stage)| {
            let built = Stage::new(&path.sub(i), inputs, stage, scheme);
            inputs = stage.channels;
            built
        })
        .collect();
    (built, inputs)
}

/// Enlarges an image bilinearly to `side` if it is smaller.
pub(super) fn enlarge_to(x: Tensor, side: i64) -> Tensor {
    if x.size()[2] == side { x } else { x.upsample_bilinear2d([side, side], false, None, None) }
}

impl MaskDecoder {
    pub(crate) fn new(
        path: &Path<'_>,
        config: &MixtureConfig,
        action: i64,
        image_size: i64,
    ) -> Self {
        let scheme = config.init;
        let decoder = &config.mask_decoder;
        let widths = [config.z_mask + action, config.mlp, config.mlp, decoder.inputs];
        let base_shape = ConvShape::same(decoder.inputs, decoder.base, 1);
        let base = Conv2d::new(&path.sub("base"), base_shape, scheme);
        let base_norm = GroupNorm::new(&path.sub("base_norm"), decoder.base_groups, decoder.base);
        let (stages, channels) = stages(path, decoder.base, &decoder.stages, scheme);
        let output = Conv2d::new(&path.sub("output"), ConvShape::same(channels, 1, 3), scheme);
        if let (InitScheme::Orthogonal, Some(bias)) = (scheme, &output.bias) {
            // Slots start small and leave the image to the last one. Having to shrink first was seen to drive
            // the whole chain before the decoder into saturation.
            let _no_grad = tch::no_grad_guard();
            let _ = bias.shallow_clone().fill_(START_LOGIT);
        }
        Self {
            condition: Mlp::new(&path.sub("condition"), &widths, scheme),
            base: (base, base_norm),
            stages,
            output,
            image_size,
            frozen: None,
        }
    }

    /// Logits of the first K-1 slots.
    ///
    /// # Shapes
    /// `z [B, K, z_mask]`, `action [B, ā]`; returns `[B, K-1, 1, H, W]`.
    pub(crate) fn forward(&self, z: &Tensor, action: &Tensor) -> Tensor {
        let (batch, slots) = (z.size()[0], z.size()[1] - 1);
        let action = action.unsqueeze(1).expand([batch, slots, -1], false);
        let condition = Tensor::cat(&[z.narrow(1, 0, slots), action], -1);
        let condition = self.condition.forward(&condition); // [B, K-1, inputs]
        let x = condition.reshape([batch * slots, -1, 1, 1]);
        let logits = if let Some(stack) = &self.frozen {
            kernels::enlarge_to(&stack.forward(&x), self.image_size, false)
        } else {
            let x = self.base.1.forward(&Activation::Celu.apply(&self.base.0.forward(&x)));
            let x = self.stages.iter().fold(x, |x, stage| stage.forward(&x));
            enlarge_to(self.output.forward(&x), self.image_size)
        };
        logits.view([batch, slots, 1, self.image_size, self.image_size])
    }

    pub(crate) fn freeze(&mut self) {
        let (base, norm) = &self.base;
        let mut layers = vec![Layer::Conv(base.kernel(), norm.after_celu())];
        layers.extend(self.stages.iter().flat_map(Stage::layers));
        layers.push(Layer::Conv(self.output.kernel(), After::only(Curve::Identity)));
        self.frozen = Stack::for_cpu(layers, 1, &self.output.weight);
    }
}

/// Stick breaking in log space: logits of K-1 slots to log masks of K slots that sum to one.
///
/// # Shapes
/// `logits [B, K-1, 1, H, W]`; returns `[B, K, 1, H, W]`.
pub(crate) fn stick_breaking(logits: &Tensor) -> Tensor {
    let taken = logits.log_sigmoid();
    let left = (-logits).log_sigmoid().cumsum(1, tch::Kind::Float); // scope after slot k
    let ones = left.narrow(1, 0, 1).zeros_like();
    let scope = Tensor::cat(&[&ones, &left], 1); // [B, K, 1, H, W]
    scope + Tensor::cat(&[&taken, &ones], 1)
}

#[cfg(test)]
mod tests {
    use tch::{Device, Kind};

    use super::*;

    #[test]
    fn masks_sum_to_one_and_follow_the_sticks() {
        let logits =
            Tensor::from_slice(&[0.3f32, -1.0, 25.0, 2.0, 0.5, -40.0]).view([1, 3, 1, 1, 2]);
        let masks = stick_breaking(&logits).exp();
        let total = masks.sum_dim_intlist(1, false, Kind::Float);
        let ones = Tensor::ones([1, 1, 1, 2], (Kind::Float, Device::Cpu));
        assert!((total - ones).abs().max().double_value(&[]) < 1e-6);
        let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
        let second = (1.0 - sigmoid(0.3)) * sigmoid(25.0);
        assert!((masks.double_value(&[0, 1, 0, 0, 0]) - second).abs() < 1e-6);
    }

    #[test]
    fn extreme_logits_stay_finite() {
        let logits = Tensor::from_slice(&[200.0f32, 200.0]).view([1, 2, 1, 1, 1]);
        assert!(stick_breaking(&logits).isfinite().all().double_value(&[]) > 0.0);
    }
}
