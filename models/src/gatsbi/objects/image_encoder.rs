//! The residual image encoder of discovery (object spec 2.1).

use tch::Tensor;

use crate::{
    config::ObjectConfig,
    kernels::{After, Curve, Layer, Stack},
    nn::{BatchNorm2d, Conv2d, ConvNorm, ConvShape, Init, InitScheme, Norm, Path},
};

/// Momentum of the running statistics.
const MOMENTUM: f64 = 0.1;

/// `[o_t, o_t - mu_mix]`, `[B, 6, H, W]`, to features of the discovery grid, `[B, hidden, G, G]`.
#[derive(Debug)]
pub(crate) struct ImageEncoder {
    stem: ConvNorm,
    blocks: Vec<BasicBlock>,
    last: Conv2d,
    image_size: i64,
    frozen: Option<Stack>,
}

impl ImageEncoder {
    pub(crate) fn new(path: &Path<'_>, config: &ObjectConfig, image_size: i64) -> Self {
        let enc = path.sub("enc");
        let channels = &config.image_encoder.channels;
        let framework = InitScheme::Framework.conv(6 * 49).0;
        let stem_shape = ConvShape::halving(6, channels[0], 7);
        let stem = Conv2d::with(&enc.sub(0), stem_shape, framework, None);
        let stem = ConvNorm::new(stem, batch_norm(&enc.sub(1), channels[0]));
        let mut blocks = Vec::new();
        let mut inputs = channels[0];
        for (stage, &outputs) in channels.iter().enumerate() {
            let stage_path = enc.sub(3 + stage);
            for block in 0..config.image_encoder.blocks {
                let stride = if stage > 0 && block == 0 { 2 } else { 1 };
                blocks.push(BasicBlock::new(&stage_path.sub(block), inputs, outputs, stride));
                inputs = outputs;
            }
        }
        let stride = image_size / (config.grid << channels.len());
        let last = ConvShape { stride, ..ConvShape::same(inputs, config.hidden, 3) };
        let last = Conv2d::new(&path.sub("last"), last, InitScheme::Framework);
        Self { stem, blocks, last, image_size, frozen: None }
    }

    pub(crate) fn forward(&self, x: &Tensor, train: bool) -> Tensor {
        if let Some(stack) = &self.frozen {
            return stack.forward(x);
        }
        let x = self.stem(x, train);
        self.last.forward(&self.blocks.iter().fold(x, |x, block| block.forward(&x, train)))
    }

    /// The first convolution with its norm and activation.
    pub(crate) fn stem(&self, x: &Tensor, train: bool) -> Tensor {
        self.stem.forward(x, train).relu()
    }

    pub(crate) fn freeze(&mut self) {
        self.stem.freeze();
        for block in &mut self.blocks {
            block.freeze();
        }
        let stem = self.stem.kernel().map(|stem| Layer::Conv(stem, After::only(Curve::Relu)));
        let last = Layer::Conv(self.last.kernel(), After::only(Curve::Identity));
        let blocks = self.blocks.iter().map(BasicBlock::layer);
        let layers = std::iter::once(stem).chain(blocks).chain([Some(last)]).collect();
        let layers: Option<Vec<Layer>> = layers;
        self.frozen =
            layers.and_then(|layers| Stack::for_cpu(layers, self.image_size, &self.last.weight));
    }
}

fn batch_norm(path: &Path<'_>, channels: i64) -> Norm {
    Norm::Batch(BatchNorm2d::new(path, channels, MOMENTUM))
}

/// Two convolutions around a shortcut (He et al. 2016).
#[derive(Debug)]
struct BasicBlock {
    first: ConvNorm,
    second: ConvNorm,
    shortcut: Option<ConvNorm>,
}

impl BasicBlock {
    fn new(path: &Path<'_>, inputs: i64, outputs: i64, stride: i64) -> Self {
        let layer = |conv: &str, norm: &str, shape| {
            let conv = Conv2d::with(&path.sub(conv), shape, Init::HeNormalFanOut, None);
            ConvNorm::new(conv, batch_norm(&path.sub(norm), outputs))
        };
        let first = ConvShape { stride, ..ConvShape::same(inputs, outputs, 3) };
        let shortcut = ConvShape { stride, ..ConvShape::same(inputs, outputs, 1) };
        let downsample = path.sub("downsample");
        Self {
            first: layer("conv1", "bn1", first),
            second: layer("conv2", "bn2", ConvShape::same(outputs, outputs, 3)),
            shortcut: (inputs != outputs || stride != 1).then(|| {
                let conv = Conv2d::with(&downsample.sub(0), shortcut, Init::HeNormalFanOut, None);
                ConvNorm::new(conv, batch_norm(&downsample.sub(1), outputs))
            }),
        }
    }

    fn forward(&self, x: &Tensor, train: bool) -> Tensor {
        let y = self.second.forward(&self.first.forward(x, train).relu(), train);
        match &self.shortcut {
            Some(shortcut) => (y + shortcut.forward(x, train)).relu(),
            None => (y + x).relu(),
        }
    }

    /// The same for a CPU, once it is frozen.
    fn layer(&self) -> Option<Layer> {
        let shortcut = match &self.shortcut {
            Some(shortcut) => Some(shortcut.kernel()?),
            None => None,
        };
        Some(Layer::Residual {
            first: self.first.kernel()?,
            second: self.second.kernel()?,
            shortcut,
        })
    }

    fn freeze(&mut self) {
        self.first.freeze();
        self.second.freeze();
        if let Some(shortcut) = &mut self.shortcut {
            shortcut.freeze();
        }
    }
}
