//! Metrics of pretrained networks: ST-LPIPS of images (Ghildyal & Liu 2022, AlexNet) and the features of videos that
//! the Fréchet video distance compares (Unterthiner et al. 2018; I3D on Kinetics-400, Carreira & Zisserman 2017).
//!
//! `cargo xtask metrics` provides the weights as one safetensors file.

use std::{collections::HashMap, path::Path};

use anyhow::{Context as _, ensure};
use safetensors::{Dtype, SafeTensors};
use tch::{Device, Kind, Tensor};

/// Side of the square frames I3D was trained on.
const VIDEO_SIDE: i64 = 224;

/// Fewest frames that leave I3D's last pooling one window.
const FEWEST_FRAMES: i64 = 9;

/// Pretrained weights.
#[derive(Debug)]
pub struct Perceptual {
    weights: HashMap<String, Tensor>,
}

impl Perceptual {
    /// Reads the weights.
    ///
    /// # Errors
    /// If the file cannot be read, or lacks a network's first or last layer.
    pub fn load(path: &Path, device: Device) -> anyhow::Result<Self> {
        let bytes = fs_err::read(path).context("`cargo xtask metrics` provides these weights")?;
        let file = SafeTensors::deserialize(&bytes)
            .with_context(|| format!("{} is no whole safetensors file", path.display()))?;
        let mut weights = HashMap::new();
        for (name, view) in file.tensors() {
            ensure!(
                view.dtype() == Dtype::F32,
                "{name} of {} is {:?}, expected F32",
                path.display(),
                view.dtype()
            );
            let shape: Vec<i64> = view.shape().iter().map(|size| *size as i64).collect();
            let tensor = Tensor::from_data_size(view.data(), &shape, Kind::Float);
            // Depth, height, width, in, out to the order of libtorch.
            let tensor = if name.ends_with("Conv_0.kernel") {
                tensor.permute([4, 3, 0, 1, 2]).contiguous()
            } else {
                tensor
            };
            weights.insert(name, tensor.to_device(device));
        }
        for name in ["st_lpips.net.slice1.0.weight", "i3d.params.Logits.Conv3d_0c_1x1.Conv_0.bias"]
        {
            ensure!(weights.contains_key(name), "{} has no {name}", path.display());
        }
        Ok(Self { weights })
    }

    /// Perceptual distance of each image of `[B, 3, H, W]` in [0, 1] from its counterpart: 0 for equal ones.
    pub fn st_lpips(&self, image: &Tensor, truth: &Tensor) -> Vec<f64> {
        let _no_grad = tch::no_grad_guard();
        let unit = |x: &Tensor| {
            let length = x.square().sum_dim_intlist([1i64].as_slice(), true, Kind::Float).sqrt();
            x / (length + 1e-10)
        };
        let mut distance = Tensor::zeros([image.size()[0]], (Kind::Float, image.device()));
        let pairs = self.image_features(image).into_iter().zip(self.image_features(truth));
        for (layer, (a, b)) in pairs.enumerate() {
            let difference = (unit(&a) - unit(&b)).square();
            let head = self.weight(&format!("st_lpips.lin{layer}.model.1.weight"));
            let weighted = difference.conv2d::<Tensor>(head, None, [1, 1], [0, 0], [1, 1], 1);
            distance += weighted.mean_dim([1i64, 2, 3].as_slice(), false, Kind::Float);
        }
        distance.to_kind(Kind::Double).try_into().expect("one number per row")
    }

    /// Activations of AlexNet's five convolutions, with blurred subsampling.
    fn image_features(&self, image: &Tensor) -> [Tensor; 5] {
        let conv = |x: &Tensor, name: &str, padding: i64| {
            let [weight, bias] =
                ["weight", "bias"].map(|part| self.weight(&format!("st_lpips.net.{name}.{part}")));
            x.conv2d(weight, Some(bias), [1, 1], [padding, padding], [1, 1], 1)
        };
        let pool = |x: &Tensor| x.max_pool2d([3, 3], [1, 1], [0, 0], [1, 1], false);
        let scaled = (image * 2.0 - 1.0 - self.weight("st_lpips.scaling_layer.shift"))
            / self.weight("st_lpips.scaling_layer.scale");
        let first = blur_pool(&conv(&scaled, "slice1.0", 2)).relu();
        let second = conv(&blur_pool(&pool(&first)), "slice2.5", 2).relu();
        let third = conv(&blur_pool(&pool(&second)), "slice3.9", 1).relu();
        let fourth = conv(&third, "slice4.11", 1).relu();
        let fifth = conv(&fourth, "slice5.13", 1).relu();
        [first, second, third, fourth, fifth]
    }

    /// Kinetics-400 logits of videos `[B, 3, T, H, W]` in [0, 1], at least nine frames long: `[B, 400]`.
    pub fn video_features(&self, video: &Tensor) -> Tensor {
        let _no_grad = tch::no_grad_guard();
        let (batch, channels, frames, ..) = video.size5().expect("a batch of videos");
        assert!(frames >= FEWEST_FRAMES, "a video has {frames} frames, expected {FEWEST_FRAMES}");
        let side = VIDEO_SIDE;
        let images = video.transpose(1, 2).flatten(0, 1);
        let images = images.upsample_bilinear2d([side, side], false, None, None);
        let x = images.view([batch, frames, channels, side, side]).transpose(1, 2) * 2.0 - 1.0;
        let x = self.unit(&x, "Conv3d_1a_7x7", 2);
        let x = max_pool(&x, [1, 3, 3], [1, 2, 2]);
        let x = self.unit(&x, "Conv3d_2b_1x1", 1);
        let x = self.unit(&x, "Conv3d_2c_3x3", 1);
        let x = max_pool(&x, [1, 3, 3], [1, 2, 2]);
        let x = self.mixed(x, &["Mixed_3b", "Mixed_3c"]);
        let x = max_pool(&x, [3, 3, 3], [2, 2, 2]);
        let x = self.mixed(x, &["Mixed_4b", "Mixed_4c", "Mixed_4d", "Mixed_4e", "Mixed_4f"]);
        let x = max_pool(&x, [2, 2, 2], [2, 2, 2]);
        let x = self.mixed(x, &["Mixed_5b", "Mixed_5c"]);
        let x = x.avg_pool3d([2, 7, 7], [1, 1, 1], [0, 0, 0], false, true, None);
        let name = "i3d.params.Logits.Conv3d_0c_1x1.Conv_0";
        let [kernel, bias] = ["kernel", "bias"].map(|part| self.weight(&format!("{name}.{part}")));
        let logits = x.conv3d(kernel, Some(bias), [1, 1, 1], [0, 0, 0], [1, 1, 1], 1);
        logits.mean_dim([2i64, 3, 4].as_slice(), false, Kind::Float)
    }

    /// Inception blocks.
    fn mixed(&self, x: Tensor, names: &[&str]) -> Tensor {
        names.iter().fold(x, |x, name| {
            let unit = |x: &Tensor, part: &str| self.unit(x, &format!("{name}.{part}"), 1);
            // The published network calls this layer differently in one block.
            let second = ["Branch_2.Conv3d_0b_3x3", "Branch_2.Conv3d_0a_3x3"]
                .into_iter()
                .find(|part| self.weights.contains_key(&kernel_of(&format!("{name}.{part}"))))
                .expect("an inception block has a second branch");
            let branches = [
                unit(&x, "Branch_0.Conv3d_0a_1x1"),
                unit(&unit(&x, "Branch_1.Conv3d_0a_1x1"), "Branch_1.Conv3d_0b_3x3"),
                unit(&unit(&x, "Branch_2.Conv3d_0a_1x1"), second),
                unit(&max_pool(&x, [3, 3, 3], [1, 1, 1]), "Branch_3.Conv3d_0b_1x1"),
            ];
            Tensor::cat(&branches, 1)
        })
    }

    /// Convolution, normalisation by running statistics, rectifier.
    fn unit(&self, x: &Tensor, name: &str, stride: i64) -> Tensor {
        let kernel = self.weight(&kernel_of(name));
        let size = kernel.size();
        let padded = pad_same(x, [size[2], size[3], size[4]], [stride; 3]);
        let x = padded.conv3d::<Tensor>(kernel, None, [stride; 3], [0, 0, 0], [1, 1, 1], 1);
        let statistic = |part: &str| {
            self.weight(&format!("i3d.batch_stats.{name}.BatchNorm_0.{part}")).view([-1, 1, 1, 1])
        };
        let bias = self.weight(&format!("i3d.params.{name}.BatchNorm_0.bias")).view([-1, 1, 1, 1]);
        ((x - statistic("mean")) * (statistic("var") + 1e-3).rsqrt() + bias).relu()
    }

    fn weight(&self, name: &str) -> &Tensor {
        self.weights.get(name).unwrap_or_else(|| panic!("the metrics' weights have no {name}"))
    }
}

fn kernel_of(name: &str) -> String {
    format!("i3d.params.{name}.Conv_0.kernel")
}

/// Every second pixel of an image blurred with the outer product of [1, 2, 1] / 4, edges mirrored.
fn blur_pool(x: &Tensor) -> Tensor {
    let line = Tensor::from_slice(&[0.25f32, 0.5, 0.25]).to_device(x.device());
    let channels = x.size()[1];
    let filter = line.unsqueeze(1).matmul(&line.unsqueeze(0)).expand([channels, 1, 3, 3], false);
    let padded = x.reflection_pad2d([2, 2, 2, 2]);
    padded.conv2d::<Tensor>(&filter, None, [2, 2], [0, 0], [1, 1], channels)
}

/// Pads `[B, C, T, H, W]` with zeros so that windows at every stride cover it, the odd one behind.
fn pad_same(x: &Tensor, kernel: [i64; 3], stride: [i64; 3]) -> Tensor {
    let mut padding = Vec::new();
    for axis in (0..3).rev() {
        let size = x.size()[2 + axis];
        let windows = (size + stride[axis] - 1) / stride[axis];
        let total = ((windows - 1) * stride[axis] + kernel[axis] - size).max(0);
        padding.extend([total / 2, total - total / 2]);
    }
    x.constant_pad_nd(&padding)
}

/// Largest value of each window, of activations that are not negative: padding with zeros changes nothing.
fn max_pool(x: &Tensor, kernel: [i64; 3], stride: [i64; 3]) -> Tensor {
    let padded = pad_same(x, kernel, stride);
    padded.max_pool3d(kernel, stride, [0, 0, 0], [1, 1, 1], false)
}

/// Fréchet distance of two sets of features `[N, D]`, as if both were normally distributed; with fewer videos than
/// features it depends on their number, so compare equal numbers only.
pub fn frechet_distance(a: &Tensor, b: &Tensor) -> f64 {
    let moments = |x: &Tensor| {
        let x = x.to_kind(Kind::Double);
        let mean = x.mean_dim([0i64].as_slice(), false, Kind::Double);
        let centred = &x - &mean;
        let covariance = centred.tr().matmul(&centred) / (x.size()[0] - 1) as f64;
        (mean, covariance)
    };
    let ((mean_a, a), (mean_b, b)) = (moments(a), moments(b));
    // trace of sqrt(ab) = trace of sqrt(sqrt(a) b sqrt(a)), which is symmetric.
    let (values, vectors) = a.linalg_eigh("L");
    let root = vectors.matmul(&values.clamp_min(0.0).sqrt().diag_embed(0, -2, -1));
    let root = root.matmul(&vectors.tr());
    let product = root.matmul(&b).matmul(&root);
    let both = product.linalg_eigvalsh("L").clamp_min(0.0).sqrt().sum(Kind::Double);
    let apart = (mean_a - mean_b).square().sum(Kind::Double);
    (apart + a.trace() + b.trace() - both * 2.0).double_value(&[])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// For diagonal covariances the distance is known: squared distance of means plus that of standard deviations.
    #[test]
    fn frechet_distance_of_separable_sets() {
        let corners = Tensor::from_slice(&[-1f32, -1., -1., 1., 1., -1., 1., 1.]).view([4, 2]);
        let shifted = &corners * Tensor::from_slice(&[2f32, 1.]) + Tensor::from_slice(&[3f32, 0.]);
        assert!(frechet_distance(&corners, &corners).abs() < 1e-9);
        // Variances with N - 1: 4/3 each, so the first deviation doubles from sqrt(4/3).
        let expected = 9.0 + 4.0 / 3.0;
        assert!((frechet_distance(&corners, &shifted) - expected).abs() < 1e-6);
    }

    #[test]
    fn windows_cover_every_frame() {
        let x = Tensor::arange(5, (Kind::Float, Device::Cpu)).view([1, 1, 5, 1, 1]);
        let pooled: Vec<f32> =
            max_pool(&x, [3, 1, 1], [2, 1, 1]).view([-1]).try_into().expect("a line");
        assert_eq!(pooled, [1.0, 3.0, 4.0]);
    }

    #[test]
    fn blurring_keeps_flat_images_and_halves_the_side() {
        let flat = Tensor::full([1, 2, 8, 8], 0.7, (Kind::Float, Device::Cpu));
        let blurred = blur_pool(&flat);
        assert_eq!(blurred.size(), [1, 2, 5, 5]);
        assert!((blurred - 0.7).abs().max().double_value(&[]) < 1e-6);
    }

    #[test]
    fn weights_that_are_not_there_are_asked_for() {
        let folder = tempfile::tempdir().expect("a folder");
        let missing = folder.path().join("none.safetensors");
        let error = format!("{:#}", Perceptual::load(&missing, Device::Cpu).unwrap_err());
        assert!(error.contains("cargo xtask metrics"), "{error}");
    }
}
