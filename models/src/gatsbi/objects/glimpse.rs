//! Encoders and the decoder of glimpses (object spec 2.4 and 2.10).

use tch::Tensor;

use crate::{
    config::ObjectConfig,
    kernels::{self, Layer, Stack},
    nn::{
        Activation, Conv2d, ConvShape, GroupNorm, InitScheme, Linear, Path,
        spatial_transformer::crop,
    },
};

/// Glimpses `[N, 3, s, s]` to features: halving convolutions with CELU and group norm, then a linear layer.
#[derive(Debug)]
pub(crate) struct GlimpseEncoder {
    convs: Vec<(Conv2d, GroupNorm)>,
    output: Linear,
    side: i64,
    frozen: Option<Stack>,
}

impl GlimpseEncoder {
    pub(crate) fn new(path: &Path<'_>, config: &ObjectConfig) -> Self {
        let encoder = &config.glimpse_encoder;
        let convs_path = path.sub("enc");
        let mut inputs = 3;
        let mut convs = Vec::new();
        for (i, (&channels, &groups)) in encoder.channels.iter().zip(&encoder.groups).enumerate() {
            let shape = ConvShape::halving(inputs, channels, 3);
            let conv = Conv2d::new(&convs_path.sub(3 * i), shape, InitScheme::Framework);
            convs.push((conv, GroupNorm::new(&convs_path.sub(3 * i + 2), groups, channels)));
            inputs = channels;
        }
        let side = config.glimpse >> encoder.channels.len();
        let output = Linear::new(
            &path.sub("enc_what"),
            inputs * side * side,
            config.hidden,
            InitScheme::Framework,
        );
        Self { convs, output, side: config.glimpse, frozen: None }
    }

    /// Cuts the glimpses that it encodes out of images.
    ///
    /// # Shapes
    /// `image [B, 3, H, W]`, `z_where [B, N, 4]`; returns `[B, N, 3, s, s]`.
    pub(crate) fn crop(&self, image: &Tensor, z_where: &Tensor) -> Tensor {
        match &self.frozen {
            Some(_) => kernels::crop(image, z_where, self.side),
            None => crop(image, z_where, self.side),
        }
    }

    /// # Shapes
    /// `[B, N, 3, s, s]`; returns `[B, N, hidden]`.
    pub(crate) fn forward(&self, glimpses: &Tensor) -> Tensor {
        let (batch, count) = (glimpses.size()[0], glimpses.size()[1]);
        let glimpses = glimpses.flatten(0, 1);
        let features = match &self.frozen {
            Some(stack) => stack.forward(&glimpses),
            None => self.convs.iter().fold(glimpses, |x, (conv, norm)| {
                norm.forward(&Activation::Celu.apply(&conv.forward(&x)))
            }),
        };
        self.output.forward(&features.flatten(1, -1)).view([batch, count, -1])
    }

    pub(crate) fn freeze(&mut self) {
        let layers = self.convs.iter();
        let layers = layers.map(|(conv, norm)| Layer::Conv(conv.kernel(), norm.after_celu()));
        self.frozen = Stack::for_cpu(layers.collect(), self.side, &self.output.weight);
    }
}

/// `z_what` to glimpses of colour and alpha, both in (0, 1).
#[derive(Debug)]
pub(crate) struct GlimpseDecoder {
    fc: Linear,
    stages: Vec<(Conv2d, GroupNorm)>,
    output: Conv2d,
}

impl GlimpseDecoder {
    pub(crate) fn new(path: &Path<'_>, config: &ObjectConfig) -> Self {
        let decoder = &config.glimpse_decoder;
        let scheme = InitScheme::Framework;
        let net = path.sub("net");
        let mut inputs = config.hidden;
        let mut stages = Vec::new();
        for (i, (&channels, &groups)) in decoder.channels.iter().zip(&decoder.groups).enumerate() {
            let shape = ConvShape::same(inputs, channels * 4, 3);
            let conv = Conv2d::new(&net.sub(4 * i), shape, scheme);
            stages.push((conv, GroupNorm::new(&net.sub(4 * i + 3), groups, channels)));
            inputs = channels;
        }
        let output_shape = ConvShape::same(inputs, 16, 3);
        Self {
            fc: Linear::new(&path.sub("fc"), config.z_what, config.hidden, scheme),
            output: Conv2d::new(&net.sub(4 * stages.len()), output_shape, scheme),
            stages,
        }
    }

    /// # Shapes
    /// `[B, N, z_what]`; returns colour and alpha as one, `[B, N, 4, s, s]`.
    pub(crate) fn forward(&self, z_what: &Tensor) -> Tensor {
        let (batch, count) = (z_what.size()[0], z_what.size()[1]);
        let x = Activation::Celu.apply(&self.fc.forward(z_what)).flatten(0, 1);
        let (first, norm) = &self.stages[0];
        // On a single pixel a padded 3x3 convolution is its middle tap.
        let x = first.middle_tap(&x).unsqueeze(-1).unsqueeze(-1); // [B N, 4 channels, 1, 1]
        let enlarge = |x: Tensor, norm: &GroupNorm| {
            norm.forward(&Activation::Celu.apply(&x.pixel_shuffle(2)))
        };
        let x = self.stages[1..]
            .iter()
            .fold(enlarge(x, norm), |x, (conv, norm)| enlarge(conv.forward(&x), norm));
        let glimpses = self.output.forward(&x).pixel_shuffle(2).sigmoid();
        let side = glimpses.size()[3];
        glimpses.view([batch, count, 4, side, side])
    }
}
