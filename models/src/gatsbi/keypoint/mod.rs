//! Keypoints: what moves with the action, as N points and as the map gamma that tells which slot is the agent
//! (mixture spec 2.6 and 4, after Minderer et al. 2019).
//!
//! [`Detector`] belongs to the model. [`KeypointLearning`] holds the networks and losses that only learning
//! keypoints needs: a decoder that has to explain a frame by the keypoints, and a recurrent model of how
//! keypoints move under actions, through which the enhanced action is learned too.

mod decoder;
mod detector;
mod dynamics;

use serde::{Deserialize, Serialize};
use tch::{Kind, Tensor};

pub use self::detector::{Detector, Keypoints};

use self::{decoder::KeypointDecoder, dynamics::KeypointDynamics};
use crate::{config::DetectorConfig, nn::Path};

/// Width of the Gaussian that keeps keypoint trajectories apart.
const SEPARATION_WIDTH: f64 = 0.1;

/// Sizes of the networks that only learning keypoints needs (mixture spec 1.1 and 6.2).
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct KeypointLearningConfig {
    /// Recurrent state of the dynamics.
    pub recurrent: i64,
    /// Latent of the dynamics.
    pub latent: i64,
    /// Width of hidden layers.
    pub mlp: i64,
    /// Samples of which the best explains the next keypoints.
    pub samples: i64,
}

/// Networks that only learning keypoints needs.
#[derive(Debug)]
pub struct KeypointLearning {
    decoder: KeypointDecoder,
    dynamics: KeypointDynamics,
    samples: i64,
}

/// Losses of a sequence, scalars (mixture spec 4).
#[derive(Debug)]
pub struct KeypointLosses {
    /// Half the squared error of the decoded frames, mean over frames.
    pub image: Tensor,
    /// How much trajectories of different keypoints move together, mean over sequences.
    pub separation: Tensor,
    /// Mean height of the heatmaps, summed over keypoints, mean over frames.
    pub sparsity: Tensor,
    /// Half the squared error of the keypoints that the dynamics explain, mean over frames.
    pub dynamics: Tensor,
    /// KL of the dynamics' latent, mean over frames.
    pub kl: Tensor,
}

impl KeypointLearning {
    /// Creates the parameters under `path`; `action` is the width of the enhanced action.
    pub fn new(
        path: &Path<'_>,
        detector: &DetectorConfig,
        config: &KeypointLearningConfig,
        action: i64,
    ) -> Self {
        let keypoints = detector.keypoints;
        Self {
            decoder: KeypointDecoder::new(&path.sub("decoder"), detector),
            dynamics: KeypointDynamics::new(&path.sub("dynamics"), config, keypoints, action),
            samples: config.samples,
        }
    }

    /// Losses of a sequence.
    ///
    /// # Shapes
    /// `frames [T][B, 3, H, W]`, their `keypoints [T]`, `actions [T][B, ā]` (the enhanced action that led to each
    /// frame); `noise [T][samples, B, latent]` standard normal.
    pub fn losses(
        &self,
        frames: &[Tensor],
        keypoints: &[Keypoints],
        actions: &[Tensor],
        noise: &[Tensor],
    ) -> KeypointLosses {
        let heatmaps: Vec<&Tensor> = keypoints.iter().map(|k| &k.heatmaps).collect();
        let points: Vec<&Tensor> = keypoints.iter().map(|k| &k.points).collect();
        let points = Tensor::stack(&points, 1); // [B, T, N, 3]
        let decoded = self.decoder.forward(&frames[0], &points, heatmaps[0].size()[2]);
        let truth = Tensor::stack(frames, 1) - 0.5; // [B, T, 3, H, W]
        let image = mean_of_half_squares(&(truth - decoded));
        let sparsity = Tensor::stack(&heatmaps, 1)
            .mean_dim([3i64, 4].as_slice(), false, Kind::Float)
            .sum_dim_intlist(2, false, Kind::Float)
            .mean(Kind::Float);
        // The dynamics explain the keypoints; they do not get to move them.
        let fixed = points.detach();
        let (dynamics, kl) = self.dynamics.losses(&fixed, actions, noise, self.samples);
        KeypointLosses { image, separation: separation(&points), sparsity, dynamics, kl }
    }
}

/// Σ over pairs of exp(-d / 2σ²) with d the mean squared distance of centred trajectories, mean over the batch.
fn separation(points: &Tensor) -> Tensor {
    let place = points.narrow(-1, 0, 2); // [B, T, N, 2]
    let centred = &place - place.mean_dim([1i64].as_slice(), true, Kind::Float);
    let difference = centred.unsqueeze(2) - centred.unsqueeze(3); // [B, T, N, N, 2]
    let distance = difference.square().sum_dim_intlist(-1, false, Kind::Float).mean_dim(
        [1i64].as_slice(),
        false,
        Kind::Float,
    ); // [B, N, N]
    let near = (distance * (-0.5 / (SEPARATION_WIDTH * SEPARATION_WIDTH))).exp();
    let itself = near.size()[1] as f64;
    near.sum_dim_intlist([1i64, 2].as_slice(), false, Kind::Float).mean(Kind::Float) - itself
}

/// Half the squares summed over everything behind `[B, T]`, mean over `[B, T]`.
fn mean_of_half_squares(x: &Tensor) -> Tensor {
    x.square().flatten(2, -1).sum_dim_intlist(-1, false, Kind::Float).mean(Kind::Float) * 0.5
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::{
        config::presets,
        nn::{Init, ParamStore},
    };

    #[test]
    fn trajectories_that_move_together_cost_most() {
        let line = Tensor::arange(4, (Kind::Float, Device::Cpu)).view([1, 4, 1, 1]) * 0.2;
        let still = line.zeros_like();
        let point = |x: &Tensor| Tensor::cat(&[x, &still, &still], -1);
        let together = Tensor::cat(&[point(&line), point(&(&line + 0.5))], 2);
        let apart = Tensor::cat(&[point(&line), point(&still)], 2);
        assert!((separation(&together).double_value(&[]) - 2.0).abs() < 1e-5);
        assert!(separation(&apart).double_value(&[]) < 0.2);
    }

    #[test]
    fn every_network_learns() {
        let detector_config = presets::tiny().detector.unwrap();
        let config = KeypointLearningConfig { recurrent: 32, latent: 8, mlp: 16, samples: 4 };
        let mut store = ParamStore::new(1, Device::Cpu);
        let (detector, learning) = store.build(|root| {
            let detector = Detector::new(&root.sub("detector"), &detector_config, 64);
            (detector, KeypointLearning::new(&root.sub("learning"), &detector_config, &config, 5))
        });
        let mut inputs = ParamStore::new(2, Device::Cpu);
        let (frames, actions, noise) = inputs.build(|root| {
            let tensor = |name: String, shape: &[i64]| {
                root.weight(&name, shape, Init::Uniform { bound: 0.5 }).detach()
            };
            let frames: Vec<_> =
                (0..3).map(|t| tensor(format!("f{t}"), &[2, 3, 64, 64]) + 0.5).collect();
            let actions: Vec<_> = (0..3).map(|t| tensor(format!("a{t}"), &[2, 5])).collect();
            let noise: Vec<_> = (0..3).map(|t| tensor(format!("n{t}"), &[4, 2, 8])).collect();
            (frames, actions, noise)
        });
        let keypoints: Vec<_> = frames.iter().map(|frame| detector.forward(frame)).collect();
        let losses = learning.losses(&frames, &keypoints, &actions, &noise);
        let total =
            losses.image + losses.separation * 0.02 + losses.sparsity + losses.dynamics + losses.kl;
        total.backward();
        for (name, parameter) in store.trainable() {
            let gradient = parameter.grad();
            assert!(gradient.defined(), "{name} gets no gradient");
            assert_eq!(gradient.isfinite().all().int64_value(&[]), 1, "{name}");
        }
    }
}
