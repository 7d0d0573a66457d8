//! The detector: frames to heatmaps, heatmaps to keypoints, keypoints to the map gamma (mixture spec 2.6 and 4).

use tch::{Kind, Tensor};

use crate::{
    config::{DetectorConfig, GammaForm},
    nn::{Activation, Conv2d, ConvShape, Init, Path},
};

/// Keeps the normalisation of heatmaps finite.
const EPS: f64 = 1e-6;

/// Standard deviation of a keypoint's Gaussian in [-1, 1] coordinates of a map of 16 pixels; the formula of the
/// reference, which gives 0.7 map pixels.
const GAUSSIAN_STD: f64 = 1.5 / 16.0;

/// Frames to keypoints.
#[derive(Debug)]
pub struct Detector {
    trunk: Trunk,
    output: Conv2d,
    gamma: GammaForm,
    image_size: i64,
}

/// Convolutions at three scales, each half the one before: the detector's and the appearance network's.
#[derive(Debug)]
pub(super) struct Trunk {
    convs: Vec<Conv2d>,
}

impl Trunk {
    pub(super) fn new(path: &Path<'_>, inputs: i64, config: &DetectorConfig) -> Self {
        let mut shapes = Vec::new();
        let mut inputs = inputs;
        for scale in 0..3 {
            let channels = config.filters << scale;
            shapes.push(if scale == 0 {
                ConvShape::same(inputs, channels, 3)
            } else {
                ConvShape::halving(inputs, channels, 3)
            });
            let extra = (0..config.convs_per_scale).map(|_| ConvShape::same(channels, channels, 3));
            shapes.extend(extra);
            inputs = channels;
        }
        let path = path.sub("conv");
        let convs = shapes.iter().enumerate().map(|(i, shape)| he_uniform(&path.sub(i), *shape));
        Self { convs: convs.collect() }
    }

    /// `[B, inputs, H, W]` to `[B, 4 filters, H/4, W/4]`.
    pub(super) fn forward(&self, x: &Tensor) -> Tensor {
        self.convs.iter().fold(x.shallow_clone(), |x, conv| leaky(&conv.forward(&x)))
    }
}

/// A convolution that starts as the keypoint networks' do.
pub(super) fn he_uniform(path: &Path<'_>, shape: ConvShape) -> Conv2d {
    let fan_in = (shape.inputs * shape.kernel * shape.kernel) as f64;
    let init = Init::Uniform { bound: (6.0 / fan_in).sqrt() };
    Conv2d::with(path, shape, init, Some(Init::Constant(0.0)))
}

/// The activation of the keypoint networks.
pub(super) fn leaky(x: &Tensor) -> Tensor {
    Activation::LeakyRelu.apply(x)
}

/// Keypoints of a batch of frames.
#[derive(Debug)]
pub struct Keypoints {
    /// Detector heatmaps, unbounded above, `[B, N, H/4, W/4]`.
    pub heatmaps: Tensor,
    /// `(x, y, strength)` with x right and y **up** in [-1, 1], strength in [0, 1], `[B, N, 3]`.
    pub points: Tensor,
}

impl Detector {
    /// Creates the parameters under `path`.
    pub fn new(path: &Path<'_>, config: &DetectorConfig, image_size: i64) -> Self {
        let output = ConvShape::same(4 * config.filters, config.keypoints, 1);
        Self {
            trunk: Trunk::new(path, 5, config),
            output: he_uniform(&path.sub("output"), output),
            gamma: config.gamma,
            image_size,
        }
    }

    /// Keypoints of frames in [0, 1], `[B, 3, H, W]`.
    pub fn forward(&self, frame: &Tensor) -> Keypoints {
        let input = Tensor::cat(&[&(frame - 0.5), &planes(frame)], 1);
        let features = self.trunk.forward(&input);
        let heatmaps = self.output.forward(&features).softplus();
        let points = points(&heatmaps);
        Keypoints { heatmaps, points }
    }

    /// The keypoint map gamma in [0, 1] at the size of the frame, `[B, 1, H, W]`.
    pub fn gamma(&self, keypoints: &Keypoints) -> Tensor {
        let maps = gaussian_maps(&keypoints.points, keypoints.heatmaps.size()[2]);
        let sum = maps.sum_dim_intlist(1, true, Kind::Float);
        let map = match self.gamma {
            GammaForm::Centred { steepness } => ((sum - 0.5) * steepness).sigmoid(),
            GammaForm::Printed => sum.sigmoid(),
        };
        let side = self.image_size;
        // The cubic kernel overshoots.
        map.upsample_bicubic2d([side, side], false, None, None).clamp(0.0, 1.0)
    }
}

/// x from left to right and y from top to bottom, as the keypoints measure them.
pub(super) fn coordinates(height: i64, width: i64, like: &Tensor) -> (Tensor, Tensor) {
    let options = (Kind::Float, like.device());
    (Tensor::linspace(-1, 1, width, options), Tensor::linspace(1, -1, height, options))
}

/// Both coordinates as planes beside an image batch `[B, C, h, w]`, `[B, 2, h, w]`.
pub(super) fn planes(like: &Tensor) -> Tensor {
    let (batch, _, height, width) = like.size4().expect("images have four axes");
    let (x, y) = coordinates(height, width, like);
    let plane = [batch, 1, height, width];
    let x = x.view([1, 1, 1, width]).expand(plane, false);
    let y = y.view([1, 1, height, 1]).expand(plane, false);
    Tensor::cat(&[x, y], 1)
}

/// Centres of mass and relative strengths of heatmaps `[B, N, h, w]`, `[B, N, 3]`.
fn points(heatmaps: &Tensor) -> Tensor {
    let (_, _, height, width) = heatmaps.size4().expect("heatmaps have four axes");
    let (x, y) = coordinates(height, width, heatmaps);
    let expectation = |summed_axis: i64, grid: &Tensor| {
        let marginal = (heatmaps + EPS).sum_dim_intlist(summed_axis, false, Kind::Float);
        let weights = &marginal / marginal.sum_dim_intlist(-1, true, Kind::Float);
        (weights * grid).sum_dim_intlist(-1, false, Kind::Float)
    };
    let strength = heatmaps.mean_dim([2i64, 3].as_slice(), false, Kind::Float);
    let strength = &strength / (strength.amax(1, true) + EPS);
    Tensor::stack(&[expectation(2, &x), expectation(3, &y), strength], -1)
}

/// One Gaussian per keypoint, as high as it is strong, `[B, N, side, side]`.
pub(super) fn gaussian_maps(points: &Tensor, side: i64) -> Tensor {
    let (x, y) = coordinates(side, side, points);
    let part = |i: i64| points.narrow(-1, i, 1).unsqueeze(-1); // [B, N, 1, 1]
    let squared =
        (x.view([1, 1, 1, -1]) - part(0)).square() + (y.view([1, 1, -1, 1]) - part(1)).square();
    (squared * (-0.5 / (GAUSSIAN_STD * GAUSSIAN_STD))).exp() * part(2)
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::{config::presets, nn::ParamStore};

    #[test]
    fn a_bright_spot_becomes_a_keypoint_there() {
        let heatmaps = Tensor::zeros([1, 2, 16, 16], (Kind::Float, Device::Cpu));
        let _ = heatmaps.get(0).get(0).get(2).get(13).fill_(5.0); // row 2, column 13
        let _ = heatmaps.get(0).get(1).get(8).get(8).fill_(1.0);
        let points = points(&heatmaps);
        let at = |n, i| points.double_value(&[0, n, i]);
        assert!((at(0, 0) - (13.0 / 7.5 - 1.0)).abs() < 1e-3);
        assert!((at(0, 1) - (1.0 - 2.0 / 7.5)).abs() < 1e-3, "y points up");
        assert!((at(0, 2) - 1.0).abs() < 1e-4 && (at(1, 2) - 0.2).abs() < 1e-4);
        let map = gaussian_maps(&points, 16).get(0).get(0);
        assert_eq!(map.argmax(None::<i64>, false).int64_value(&[]), 2 * 16 + 13);
    }

    #[test]
    fn gamma_is_low_where_nothing_is() {
        let mut store = ParamStore::new(0, Device::Cpu);
        let config = presets::tiny().detector.unwrap();
        let detector = store.build(|root| Detector::new(root, &config, 64));
        let _no_grad = tch::no_grad_guard();
        let heatmaps = Tensor::zeros([1, 12, 16, 16], (Kind::Float, Device::Cpu));
        let _ = heatmaps.narrow(2, 4, 1).narrow(3, 4, 1).fill_(1.0);
        let points = points(&heatmaps);
        let gamma = detector.gamma(&Keypoints { heatmaps, points });
        assert_eq!(gamma.size(), [1, 1, 64, 64]);
        assert!(gamma.double_value(&[0, 0, 18, 18]) > 0.95);
        assert!(gamma.double_value(&[0, 0, 60, 60]) < 0.05);
    }
}
