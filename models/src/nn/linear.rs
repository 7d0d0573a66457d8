//! Fully connected layers.

use tch::Tensor;

use super::{Activation, Path, macs, params::InitScheme};

/// `y = x Wᵀ + b` on the last axis; parameters `weight [out, in]` and `bias [out]`.
#[derive(Debug)]
pub(crate) struct Linear {
    pub(crate) weight: Tensor,
    pub(crate) bias: Tensor,
}

impl Linear {
    pub(crate) fn new(path: &Path<'_>, inputs: i64, outputs: i64, scheme: InitScheme) -> Self {
        Self::scaled(path, inputs, outputs, scheme, 1.0)
    }

    /// A layer whose initial weights are `scale` times the usual ones.
    pub(crate) fn scaled(
        path: &Path<'_>,
        inputs: i64,
        outputs: i64,
        scheme: InitScheme,
        scale: f64,
    ) -> Self {
        let (weight, bias) = scheme.linear(inputs, scale);
        Self {
            weight: path.weight("weight", &[outputs, inputs], weight),
            bias: path.weight("bias", &[outputs], bias),
        }
    }

    pub(crate) fn forward(&self, x: &Tensor) -> Tensor {
        linear(x, &self.weight, Some(&self.bias))
    }
}

/// `x Wᵀ + b` on the last axis.
pub(crate) fn linear(x: &Tensor, weight: &Tensor, bias: Option<&Tensor>) -> Tensor {
    let inputs = weight.size()[1].max(1) as usize;
    macs::add(x.numel() / inputs * weight.numel());
    x.linear(weight, bias)
}

/// Linear layers `layers.{0,1,...}` with an activation between them and none at the end.
#[derive(Debug)]
pub(crate) struct Mlp {
    pub(crate) layers: Vec<Linear>,
    activation: Activation,
}

impl Mlp {
    /// `widths` are input, hidden and output widths in order; CELU between.
    pub(crate) fn new(path: &Path<'_>, widths: &[i64], scheme: InitScheme) -> Self {
        Self::with(path, widths, Activation::Celu, scheme, 1.0)
    }

    /// Like [`Mlp::new`], with the activation and the initial scale of the last layer given.
    pub(crate) fn with(
        path: &Path<'_>,
        widths: &[i64],
        activation: Activation,
        scheme: InitScheme,
        last_scale: f64,
    ) -> Self {
        let path = path.sub("layers");
        let count = widths.len() - 1;
        let layers = (0..count)
            .map(|i| {
                let scale = if i + 1 == count { last_scale } else { 1.0 };
                Linear::scaled(&path.sub(i), widths[i], widths[i + 1], scheme, scale)
            })
            .collect();
        Self { layers, activation }
    }

    /// An MLP whose outputs are the means and scale parameters of a distribution of `2 d` numbers; the scale
    /// half starts small and nearly constant if the scheme asks for it.
    pub(crate) fn distribution(
        path: &Path<'_>,
        widths: &[i64],
        activation: Activation,
        scheme: InitScheme,
    ) -> Self {
        let mlp = Self::with(path, widths, activation, scheme, 1.0);
        if let (Some(last), Some((scale, bias))) = (mlp.layers.last(), scheme.scale_head()) {
            let _no_grad = tch::no_grad_guard();
            let half = last.bias.size()[0] / 2;
            let mut weight = last.weight.narrow(0, half, half);
            let _ = weight.g_mul_scalar_(scale);
            let _ = last.bias.narrow(0, half, half).fill_(bias);
        }
        mlp
    }

    pub(crate) fn forward(&self, x: &Tensor) -> Tensor {
        self.tail(&self.layers[0].forward(x))
    }

    /// Everything after the first layer, for callers that compute the first layer's output another way.
    pub(crate) fn tail(&self, first: &Tensor) -> Tensor {
        self.layers[1..]
            .iter()
            .fold(first.shallow_clone(), |x, layer| layer.forward(&self.activation.apply(&x)))
    }
}
