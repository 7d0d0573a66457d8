//! DEC_COMP: component latents to images (mixture spec 2.3; the sub-pixel form is decisions row 15).

use tch::{Kind, Tensor};

use super::mask_decoder::{Stage, enlarge_to, stages};
use crate::{
    config::{CompDecoderConfig, CompNorm, MixtureConfig},
    kernels::{self, After, Curve, Layer, Stack},
    nn::{
        Activation, BatchNorm2d, Conv2d, ConvNorm, ConvShape, GroupNorm, Linear, Mlp, Norm, Path,
        linear,
    },
};

/// Momentum of the component networks' batch norms: observed and imagined, early and late steps mix in them.
const MOMENTUM: f64 = 0.01;

/// The normalisation that follows a convolution of a component network.
pub(super) fn comp_norm(path: &Path<'_>, kind: CompNorm, channels: i64) -> Norm {
    match kind {
        CompNorm::Batch => Norm::Batch(BatchNorm2d::new(path, channels, MOMENTUM)),
        CompNorm::Group => Norm::Group(GroupNorm::new(path, (channels / 8).max(1), channels)),
    }
}

/// Component latents and the action to component images.
#[derive(Debug)]
pub(crate) struct CompDecoder {
    condition: Mlp,
    image: ImageDecoder,
    image_size: i64,
}

#[derive(Debug)]
enum ImageDecoder {
    Broadcast(BroadcastDecoder),
    SubPixel(SubPixelDecoder),
}

impl CompDecoder {
    pub(crate) fn new(
        path: &Path<'_>,
        config: &MixtureConfig,
        action: i64,
        image_size: i64,
    ) -> Self {
        let inputs = config.comp_decoder.inputs();
        let widths = [config.z_comp + action, config.mlp, config.mlp, inputs];
        let image = match &config.comp_decoder {
            CompDecoderConfig::Broadcast { width, final_kernel, .. } => {
                let sizes = BroadcastSizes { inputs, width: *width, final_kernel: *final_kernel };
                ImageDecoder::Broadcast(BroadcastDecoder::new(path, config, sizes, image_size))
            }
            CompDecoderConfig::SubPixel { .. } => {
                ImageDecoder::SubPixel(SubPixelDecoder::new(path, config))
            }
        };
        Self {
            condition: Mlp::new(&path.sub("condition"), &widths, config.init),
            image,
            image_size,
        }
    }

    /// # Shapes
    /// `z [B, K, z_comp]`, `action [B, ā]`; returns images in [0, 1], `[B, K, 3, H, W]`.
    pub(crate) fn forward(&self, z: &Tensor, action: &Tensor, train: bool) -> Tensor {
        let (batch, slots) = (z.size()[0], z.size()[1]);
        let action = action.unsqueeze(1).expand([batch, slots, -1], false);
        let condition = self.condition.forward(&Tensor::cat(&[z, &action], -1));
        let condition = condition.flatten(0, 1); // [B K, inputs]
        let image = match &self.image {
            ImageDecoder::Broadcast(decoder) => decoder.forward(&condition, train),
            ImageDecoder::SubPixel(decoder) => decoder.forward(&condition),
        };
        let side = self.image_size;
        let image = match &self.image {
            ImageDecoder::Broadcast(BroadcastDecoder { stack: Some(_), .. })
            | ImageDecoder::SubPixel(SubPixelDecoder { frozen: Some(_), .. }) => {
                kernels::enlarge_to(&image, side, true)
            }
            _ => enlarge_to(image, side).sigmoid(),
        };
        image.view([batch, slots, 3, side, side])
    }

    pub(crate) fn freeze(&mut self) {
        match &mut self.image {
            ImageDecoder::Broadcast(decoder) => decoder.freeze(),
            ImageDecoder::SubPixel(decoder) => decoder.freeze(),
        }
    }
}

#[derive(Clone, Copy)]
struct BroadcastSizes {
    inputs: i64,
    width: i64,
    final_kernel: i64,
}

/// Spatial broadcast decoder. Its first convolution is never run over the broadcast latent: unpadded over
/// spatially constant channels it is one matrix product plus a fixed map (mixture spec 7, row 1).
#[derive(Debug)]
struct BroadcastDecoder {
    first: ConvNorm,
    hidden: Vec<ConvNorm>,
    output: Conv2d,
    inputs: i64,
    grid: i64,
    frozen: Option<FirstLayer>,
    stack: Option<Stack>,
}

/// The first convolution in closed form.
#[derive(Debug)]
struct FirstLayer {
    /// Taps of the latent's columns summed, `[width, inputs]`.
    matrix: Tensor,
    /// Convolved coordinates and bias, `[width, H, W]`.
    map: Tensor,
}

impl BroadcastDecoder {
    fn new(
        path: &Path<'_>,
        config: &MixtureConfig,
        sizes: BroadcastSizes,
        image_size: i64,
    ) -> Self {
        let BroadcastSizes { inputs, width, final_kernel } = sizes;
        let layer = |i: i64, inputs| {
            let shape = ConvShape::valid(inputs, width, 3);
            let conv = Conv2d::new(&path.sub("conv").sub(i), shape, config.init);
            ConvNorm::new(conv, comp_norm(&path.sub("norm").sub(i), config.comp_norm, width))
        };
        let output_shape = ConvShape::valid(width, 3, final_kernel);
        Self {
            first: layer(0, inputs + 2),
            hidden: vec![layer(1, width), layer(2, width)],
            output: Conv2d::new(&path.sub("output"), output_shape, config.init),
            inputs,
            grid: image_size + 6 + final_kernel - 1,
            frozen: None,
            stack: None,
        }
    }

    /// `[N, inputs]` to logits `[N, 3, H, W]`.
    fn forward(&self, z: &Tensor, train: bool) -> Tensor {
        if let (Some(layer), Some(stack)) = (&self.frozen, &self.stack) {
            return stack.forward(&linear(z, &layer.matrix, None));
        }
        let apply = |layer: &FirstLayer| {
            linear(z, &layer.matrix, None).unsqueeze(-1).unsqueeze(-1) + &layer.map
        };
        let x = match &self.frozen {
            Some(layer) => apply(layer),
            None => self.first.norm.forward(&apply(&self.first_layer()), train),
        };
        let x = self.hidden.iter().fold(Activation::Elu.apply(&x), |x, layer| {
            Activation::Elu.apply(&layer.forward(&x, train))
        });
        self.output.forward(&x)
    }

    fn first_layer(&self) -> FirstLayer {
        let weight = &self.first.conv.weight;
        let matrix = weight.narrow(1, 0, self.inputs).sum_dim_intlist(
            [2i64, 3].as_slice(),
            false,
            Kind::Float,
        );
        let coordinates = self.coordinates(weight);
        let map = coordinates.conv2d(
            &weight.narrow(1, self.inputs, 2),
            self.first.conv.bias.as_ref(),
            [1, 1],
            [0, 0],
            [1, 1],
            1,
        );
        FirstLayer { matrix, map: map.squeeze_dim(0) }
    }

    /// x then y, both from -1 to 1 over the enlarged grid, `[1, 2, grid, grid]`.
    fn coordinates(&self, like: &Tensor) -> Tensor {
        let line = Tensor::linspace(-1, 1, self.grid, (Kind::Float, like.device()));
        let shape = [1, 1, self.grid, self.grid];
        let x = line.view([1, 1, 1, -1]).expand(shape, false);
        let y = line.view([1, 1, -1, 1]).expand(shape, false);
        Tensor::cat(&[x, y], 1)
    }

    fn freeze(&mut self) {
        let _no_grad = tch::no_grad_guard();
        for layer in &mut self.hidden {
            layer.freeze();
        }
        if let Norm::Batch(norm) = &self.first.norm {
            let (factor, offset) = norm.affine();
            let FirstLayer { matrix, map } = self.first_layer();
            let matrix = matrix * factor.unsqueeze(1);
            let map = map * factor.view([-1, 1, 1]) + offset.view([-1, 1, 1]);
            let hidden = self.hidden.iter().map(|layer| {
                let conv = layer.kernel().expect("batch norms are folded");
                Layer::Conv(conv, After::only(Curve::Elu))
            });
            let layers = std::iter::once(Layer::spread(&map)).chain(hidden);
            let output = Layer::Conv(self.output.kernel(), After::only(Curve::Identity));
            let layers = layers.chain([output]).collect();
            self.stack = Stack::for_cpu(layers, 1, &matrix);
            self.frozen = Some(FirstLayer { matrix, map });
        }
    }
}

/// Sub-pixel decoder: a linear layer makes a small image, stages enlarge it.
#[derive(Debug)]
struct SubPixelDecoder {
    base: Linear,
    stages: Vec<Stage>,
    output: Conv2d,
    base_side: i64,
    frozen: Option<Stack>,
}

impl SubPixelDecoder {
    fn new(path: &Path<'_>, config: &MixtureConfig) -> Self {
        let CompDecoderConfig::SubPixel { inputs, base_side, base, stages: sizes } =
            &config.comp_decoder
        else {
            unreachable!("the caller matched this form")
        };
        let pixels = base_side * base_side;
        let (stages, channels) = stages(path, *base, sizes, config.init);
        let output_shape = ConvShape::same(channels, 3, 3);
        Self {
            base: Linear::new(&path.sub("base"), *inputs, base * pixels, config.init),
            stages,
            output: Conv2d::new(&path.sub("output"), output_shape, config.init),
            base_side: *base_side,
            frozen: None,
        }
    }

    fn forward(&self, z: &Tensor) -> Tensor {
        let side = self.base_side;
        let x = Activation::Celu.apply(&self.base.forward(z)).view([z.size()[0], -1, side, side]);
        match &self.frozen {
            Some(stack) => stack.forward(&x),
            None => self.output.forward(&self.stages.iter().fold(x, |x, stage| stage.forward(&x))),
        }
    }

    fn freeze(&mut self) {
        let mut layers: Vec<Layer> = self.stages.iter().flat_map(Stage::layers).collect();
        layers.push(Layer::Conv(self.output.kernel(), After::only(Curve::Identity)));
        self.frozen = Stack::for_cpu(layers, self.base_side, &self.output.weight);
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::{config::presets, nn::ParamStore};

    fn max_difference(a: &Tensor, b: &Tensor) -> f64 {
        (a - b).abs().max().double_value(&[])
    }

    #[test]
    fn closed_first_convolution_equals_the_plain_one() {
        let config = presets::push1().mixture;
        let mut store = ParamStore::new(3, Device::Cpu);
        let sizes = BroadcastSizes { inputs: 64, width: 32, final_kernel: 3 };
        let mut decoder = store.build(|root| BroadcastDecoder::new(root, &config, sizes, 64));
        let _no_grad = tch::no_grad_guard();
        let z = Tensor::from_slice(&(0..128).map(|i| (i as f32 * 0.37).sin()).collect::<Vec<_>>())
            .view([2, 64]);
        let closed = decoder.forward(&z, true);

        let broadcast = z.view([2, 64, 1, 1]).expand([2, 64, 72, 72], false);
        let coordinates = decoder.coordinates(&z).expand([2, 2, 72, 72], false);
        let x = decoder.first.conv.forward(&Tensor::cat(&[broadcast, coordinates], 1));
        let mut x = Activation::Elu.apply(&decoder.first.norm.forward(&x, true));
        for layer in &decoder.hidden {
            x = Activation::Elu.apply(&layer.forward(&x, true));
        }
        let plain = decoder.output.forward(&x);
        assert_eq!(plain.size(), [2, 3, 64, 64]);
        // Sums of 600 products in another order: 1.1e-5 with AVX2, less with AVX-512.
        let difference = max_difference(&closed, &plain);
        assert!(difference < 2e-5, "{difference:e}");

        let unfolded = decoder.forward(&z, false);
        decoder.freeze();
        assert!(max_difference(&decoder.forward(&z, false), &unfolded) < 1e-5);
    }
}
