//! A frame from its keypoints and the appearance of the sequence's first frame (mixture spec 2.6): what cannot
//! be explained by keypoints costs, so keypoints go where things move.

use tch::Tensor;

use super::detector::{Trunk, gaussian_maps, he_uniform, leaky, planes};
use crate::{
    config::DetectorConfig,
    nn::{Conv2d, ConvShape, Path},
};

/// APP, KP_IN and KP_DEC.
#[derive(Debug)]
pub(super) struct KeypointDecoder {
    appearance: Trunk,
    input: Conv2d,
    scales: [Vec<Conv2d>; 2],
    output: Conv2d,
}

impl KeypointDecoder {
    pub(super) fn new(path: &Path<'_>, config: &DetectorConfig) -> Self {
        let (filters, keypoints) = (config.filters, config.keypoints);
        let widest = 4 * filters;
        let scale = |name: &str, inputs: i64, outputs: i64| -> Vec<Conv2d> {
            (0..config.convs_per_scale.max(1))
                .map(|i| {
                    let inputs = if i == 0 { inputs } else { outputs };
                    he_uniform(&path.sub(name).sub(i), ConvShape::same(inputs, outputs, 3))
                })
                .collect()
        };
        let input = ConvShape::same(2 * keypoints + widest + 2, widest, 1);
        Self {
            appearance: Trunk::new(&path.sub("appearance"), 3, config),
            input: he_uniform(&path.sub("input"), input),
            scales: [scale("middle", widest, 2 * filters), scale("fine", 2 * filters, filters)],
            output: he_uniform(&path.sub("output"), ConvShape::same(filters, 3, 1)),
        }
    }

    /// # Shapes
    /// `first [B, 3, H, W]` in [0, 1], `points [B, T, N, 3]`, maps of `side` pixels; returns frames shifted to
    /// [-1/2, 1/2], `[B, T, 3, H, W]`.
    pub(super) fn forward(&self, first: &Tensor, points: &Tensor, side: i64) -> Tensor {
        let (batch, steps) = (points.size()[0], points.size()[1]);
        let first = first - 0.5;
        let repeat = |x: &Tensor| {
            let mut shape = vec![batch, steps];
            shape.extend(&x.size()[1..]);
            x.unsqueeze(1).expand(&shape, false).flatten(0, 1)
        };
        let maps = gaussian_maps(&points.flatten(0, 1), side); // [B T, N, side, side]
        let first_maps = gaussian_maps(&points.select(1, 0), side);
        let appearance = self.appearance.forward(&first);
        let input =
            Tensor::cat(&[&maps, &repeat(&appearance), &repeat(&first_maps), &planes(&maps)], 1);
        let mut x = leaky(&self.input.forward(&input));
        for convs in &self.scales {
            let (_, _, height, width) = x.size4().expect("images have four axes");
            x = x.upsample_bilinear2d([2 * height, 2 * width], true, None, None);
            x = convs.iter().fold(x, |x, conv| leaky(&conv.forward(&x)));
        }
        let change = self.output.forward(&x);
        let shape = [batch, steps, 3, change.size()[2], change.size()[3]];
        change.view(shape) + first.unsqueeze(1)
    }
}
