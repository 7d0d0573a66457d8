//! How keypoints move under actions: a recurrent latent-variable model (mixture spec 2.6 and 4).

use tch::{Kind, Tensor};

use super::KeypointLearningConfig;
use crate::nn::{Init, InitScheme, Linear, Normal, Path};

/// KP_PRIOR, KP_POST, KP_OUT and KP_RNN.
#[derive(Debug)]
pub(super) struct KeypointDynamics {
    prior: Head,
    posterior: Head,
    output: Head,
    recurrent: GruCell,
    hidden: i64,
}

impl KeypointDynamics {
    pub(super) fn new(
        path: &Path<'_>,
        config: &KeypointLearningConfig,
        keypoints: i64,
        action: i64,
    ) -> Self {
        let KeypointLearningConfig { recurrent, latent, mlp, .. } = *config;
        let points = 3 * keypoints;
        let head = |name: &str, inputs, outputs| Head::new(&path.sub(name), [inputs, mlp, outputs]);
        Self {
            prior: head("prior", recurrent + action, 2 * latent),
            posterior: head("posterior", recurrent + points + action, 2 * latent),
            output: head("output", recurrent + latent, points),
            recurrent: GruCell::new(&path.sub("recurrent"), points + latent, recurrent),
            hidden: recurrent,
        }
    }

    /// Half the squared error of the best of `samples` explanations of each frame's keypoints, and the KL of the
    /// latent, both mean over frames.
    ///
    /// # Shapes
    /// `points [B, T, N, 3]`, `actions [T][B, ā]`, `noise [T][samples, B, latent]`.
    pub(super) fn losses(
        &self,
        points: &Tensor,
        actions: &[Tensor],
        noise: &[Tensor],
        samples: i64,
    ) -> (Tensor, Tensor) {
        let batch = points.size()[0];
        let mut h = Tensor::zeros([batch, self.hidden], (Kind::Float, points.device()));
        let (mut errors, mut kls) = (Vec::new(), Vec::new());
        for (t, action) in actions.iter().enumerate() {
            let truth = points.select(1, t as i64).flatten(1, -1); // [B, 3 N]
            let prior = Normal::from_head(&self.prior.forward(&Tensor::cat(&[&h, action], -1)));
            let input = Tensor::cat(&[&h, &truth, action], -1);
            let posterior = Normal::from_head(&self.posterior.forward(&input));
            let best = self.best(&h, &truth, &posterior, &noise[t], samples);
            let z = posterior.sample(&best);
            let explained = self.output.forward(&Tensor::cat(&[&h, &z], -1)).tanh();
            let sum = |x: Tensor| x.sum_dim_intlist(-1, false, Kind::Float).mean(Kind::Float);
            errors.push(sum((explained - &truth).square() * 0.5));
            kls.push(sum(posterior.kl(&prior)));
            h = self.recurrent.forward(&Tensor::cat(&[&truth, &z], -1), &h);
        }
        let mean = |terms: &[Tensor]| Tensor::stack(terms, 0).mean(Kind::Float);
        (mean(&errors), mean(&kls))
    }

    /// The noise `[B, latent]` of the sample that explains the keypoints best; only it is learned from.
    fn best(
        &self,
        h: &Tensor,
        truth: &Tensor,
        posterior: &Normal,
        noise: &Tensor,
        samples: i64,
    ) -> Tensor {
        let _no_grad = tch::no_grad_guard();
        let z = posterior.sample(noise); // [samples, B, latent]
        let h = h.unsqueeze(0).expand([samples, -1, -1], false);
        let explained = self.output.forward(&Tensor::cat(&[h, z], -1)).tanh();
        let error = (explained - truth).square().sum_dim_intlist(-1, false, Kind::Float);
        let best = error.argmin(0, false).view([1, -1, 1]); // [1, B, 1]
        let latent = noise.size()[2];
        noise.gather(0, &best.expand([-1, -1, latent], false), false).squeeze_dim(0)
    }
}

/// Linear, ReLU, linear.
#[derive(Debug)]
struct Head {
    hidden: Linear,
    output: Linear,
}

impl Head {
    fn new(path: &Path<'_>, [inputs, hidden, outputs]: [i64; 3]) -> Self {
        let linear = |name, inputs, outputs| {
            Linear::new(&path.sub(name), inputs, outputs, InitScheme::Framework)
        };
        Self { hidden: linear("hidden", inputs, hidden), output: linear("output", hidden, outputs) }
    }

    fn forward(&self, x: &Tensor) -> Tensor {
        self.output.forward(&self.hidden.forward(x).relu())
    }
}

/// One GRU cell.
#[derive(Debug)]
struct GruCell {
    weight_ih: Tensor,
    weight_hh: Tensor,
    bias_ih: Tensor,
    bias_hh: Tensor,
}

impl GruCell {
    fn new(path: &Path<'_>, inputs: i64, hidden: i64) -> Self {
        let init = Init::Uniform { bound: 1.0 / (hidden as f64).sqrt() };
        Self {
            weight_ih: path.weight("weight_ih", &[3 * hidden, inputs], init),
            weight_hh: path.weight("weight_hh", &[3 * hidden, hidden], init),
            bias_ih: path.weight("bias_ih", &[3 * hidden], init),
            bias_hh: path.weight("bias_hh", &[3 * hidden], init),
        }
    }

    fn forward(&self, x: &Tensor, h: &Tensor) -> Tensor {
        let bias = (Some(&self.bias_ih), Some(&self.bias_hh));
        x.gru_cell(h, &self.weight_ih, &self.weight_hh, bias.0, bias.1)
    }
}
