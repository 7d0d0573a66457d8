//! Image metrics, per image of a batch `[B, 3, H, W]` in [0, 1].

use tch::{Kind, Tensor};

/// Metrics of a predicted image, in the order of [`NAMES`].
pub const NAMES: [&str; 4] = ["psnr", "ssim", "mse", "cosine"];

/// Constants of SSIM for images in [0, 1] (Wang et al. 2004).
const SSIM_C: (f64, f64) = (0.01 * 0.01, 0.03 * 0.03);

/// Side and standard deviation of SSIM's Gaussian window.
const WINDOW: (i64, f64) = (11, 1.5);

/// All metrics of each image, `[B][4]`.
pub fn all(image: &Tensor, truth: &Tensor) -> Vec<[f64; 4]> {
    let columns: [Vec<f64>; 4] =
        [psnr(image, truth), ssim(image, truth), mse(image, truth), cosine(image, truth)];
    (0..columns[0].len()).map(|row| columns.each_ref().map(|column| column[row])).collect()
}

/// Peak signal-to-noise ratio in dB.
pub fn psnr(image: &Tensor, truth: &Tensor) -> Vec<f64> {
    mse(image, truth).iter().map(|error| -10.0 * error.max(1e-10).log10()).collect()
}

/// Mean squared error.
pub fn mse(image: &Tensor, truth: &Tensor) -> Vec<f64> {
    per_row(&(image - truth).square().flatten(1, -1).mean_dim(
        [1i64].as_slice(),
        false,
        Kind::Float,
    ))
}

/// Cosine of the angle between the images as vectors.
pub fn cosine(image: &Tensor, truth: &Tensor) -> Vec<f64> {
    let (a, b) = (image.flatten(1, -1), truth.flatten(1, -1));
    per_row(&Tensor::cosine_similarity(&a, &b, 1, 1e-8))
}

/// Structural similarity, mean over pixels and channels, Gaussian window without padding.
pub fn ssim(image: &Tensor, truth: &Tensor) -> Vec<f64> {
    let (side, std) = WINDOW;
    let x = Tensor::arange(side, (Kind::Float, image.device())) - (side / 2) as f64;
    let line = (x.square() / (-2.0 * std * std)).exp();
    let line = &line / line.sum(Kind::Float);
    let window = line.unsqueeze(1).matmul(&line.unsqueeze(0)).expand([3, 1, side, side], false);
    let blur = |x: &Tensor| x.conv2d::<Tensor>(&window, None, [1, 1], [0, 0], [1, 1], 3);
    let (mean_a, mean_b) = (blur(image), blur(truth));
    let variance_a = blur(&image.square()) - mean_a.square();
    let variance_b = blur(&truth.square()) - mean_b.square();
    let covariance = blur(&(image * truth)) - &mean_a * &mean_b;
    let (c1, c2) = SSIM_C;
    let luminance = (&mean_a * &mean_b * 2.0 + c1) / (mean_a.square() + mean_b.square() + c1);
    let structure = (covariance * 2.0 + c2) / (variance_a + variance_b + c2);
    per_row(&(luminance * structure).flatten(1, -1).mean_dim([1i64].as_slice(), false, Kind::Float))
}

fn per_row(x: &Tensor) -> Vec<f64> {
    x.to_kind(Kind::Double).try_into().expect("one number per row")
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    #[test]
    fn equal_images_are_perfect_and_known_errors_are_met() {
        let options = (Kind::Float, Device::Cpu);
        let image = Tensor::arange(3 * 32 * 32, options).view([1, 3, 32, 32]) / 3072.0;
        let [psnr, ssim, mse, cosine] = all(&image, &image)[0];
        assert!(psnr > 99.0 && (ssim - 1.0).abs() < 1e-5 && mse == 0.0);
        assert!((cosine - 1.0).abs() < 1e-5);
        let [psnr, ..] = all(&(&image + 0.1), &image)[0];
        assert!((psnr - 20.0).abs() < 1e-3);
    }

    /// A black and a mid-grey image: SSIM is the luminance term alone.
    #[test]
    fn ssim_of_flat_images_is_the_luminance_term() {
        let options = (Kind::Float, Device::Cpu);
        let flat = |value| Tensor::full([1, 3, 16, 16], value, options);
        let expected = (2.0 * 0.2 * 0.5 + 1e-4) / (0.04 + 0.25 + 1e-4);
        assert!((ssim(&flat(0.2), &flat(0.5))[0] - expected).abs() < 1e-4);
    }
}
