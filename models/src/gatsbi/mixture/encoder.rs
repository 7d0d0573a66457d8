//! ENC: the encoder of frames and of `mu_mix` (mixture spec 2.1).

use tch::Tensor;

use crate::{
    config::{EncoderConfig, InitScheme},
    kernels::{Layer, Stack},
    nn::{Activation, Conv2d, ConvShape, GroupNorm, Linear, Path},
};

/// `[B, 3, H, W]` to `[B, features]`; strided convolutions with CELU and group norm, then a linear layer.
#[derive(Debug)]
pub(crate) struct FrameEncoder {
    convs: Vec<(Conv2d, GroupNorm)>,
    output: Linear,
    image_size: i64,
    frozen: Option<Stack>,
}

impl FrameEncoder {
    pub(crate) fn new(
        path: &Path<'_>,
        config: &EncoderConfig,
        image_size: i64,
        scheme: InitScheme,
    ) -> Self {
        let mut inputs = 3;
        let mut convs = Vec::new();
        for (i, (&channels, &groups)) in config.channels.iter().zip(&config.groups).enumerate() {
            let kernel = if i == 0 { config.first_kernel } else { 3 };
            let shape = ConvShape::halving(inputs, channels, kernel);
            let conv = Conv2d::new(&path.sub("conv").sub(i), shape, scheme);
            convs.push((conv, GroupNorm::new(&path.sub("norm").sub(i), groups, channels)));
            inputs = channels;
        }
        let side = image_size >> config.channels.len();
        let output =
            Linear::new(&path.sub("output"), inputs * side * side, config.features, scheme);
        Self { convs, output, image_size, frozen: None }
    }

    pub(crate) fn forward(&self, image: &Tensor) -> Tensor {
        let features = match &self.frozen {
            Some(stack) => stack.forward(image),
            None => self.convs.iter().fold(image.shallow_clone(), |x, (conv, norm)| {
                norm.forward(&Activation::Celu.apply(&conv.forward(&x)))
            }),
        };
        self.output.forward(&features.flatten(1, -1))
    }

    pub(crate) fn freeze(&mut self) {
        let layers = self.convs.iter();
        let layers = layers.map(|(conv, norm)| Layer::Conv(conv.kernel(), norm.after_celu()));
        self.frozen = Stack::for_cpu(layers.collect(), self.image_size, &self.output.weight);
    }
}
