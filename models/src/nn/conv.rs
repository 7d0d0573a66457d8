//! Convolutions and the normalisations that follow them.

use tch::Tensor;

use super::{
    Activation, Path, linear, macs,
    params::{Init, InitScheme},
};
use crate::kernels;

/// Epsilon of every normalisation layer.
const EPS: f64 = 1e-5;

/// Square convolution; parameters `weight [out, in, k, k]` and, if it has one, `bias [out]`.
#[derive(Debug)]
pub(crate) struct Conv2d {
    pub(crate) weight: Tensor,
    pub(crate) bias: Option<Tensor>,
    stride: i64,
    padding: i64,
}

/// Sizes of a [`Conv2d`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct ConvShape {
    pub(crate) inputs: i64,
    pub(crate) outputs: i64,
    pub(crate) kernel: i64,
    pub(crate) stride: i64,
    pub(crate) padding: i64,
}

impl ConvShape {
    /// A convolution that keeps the size of its input.
    pub(crate) fn same(inputs: i64, outputs: i64, kernel: i64) -> Self {
        Self { inputs, outputs, kernel, stride: 1, padding: kernel / 2 }
    }

    /// A convolution that halves the size of its (even) input.
    pub(crate) fn halving(inputs: i64, outputs: i64, kernel: i64) -> Self {
        Self { stride: 2, ..Self::same(inputs, outputs, kernel) }
    }

    /// A convolution without padding.
    pub(crate) fn valid(inputs: i64, outputs: i64, kernel: i64) -> Self {
        Self { padding: 0, ..Self::same(inputs, outputs, kernel) }
    }
}

impl Conv2d {
    pub(crate) fn new(path: &Path<'_>, shape: ConvShape, scheme: InitScheme) -> Self {
        let (weight, bias) = scheme.conv(shape.inputs * shape.kernel * shape.kernel);
        Self::with(path, shape, weight, Some(bias))
    }

    /// A convolution with the initial values given; no bias if `bias` is `None`.
    pub(crate) fn with(
        path: &Path<'_>,
        shape: ConvShape,
        weight: Init,
        bias: Option<Init>,
    ) -> Self {
        let ConvShape { inputs, outputs, kernel, stride, padding } = shape;
        Self {
            weight: path.weight("weight", &[outputs, inputs, kernel, kernel], weight),
            bias: bias.map(|init| path.weight("bias", &[outputs], init)),
            stride,
            padding,
        }
    }

    /// # Shapes
    /// `[B, in, H, W]` to `[B, out, H', W']`.
    pub(crate) fn forward(&self, x: &Tensor) -> Tensor {
        self.forward_with(x, &self.weight, self.bias.as_ref())
    }

    /// Weight `[out, in]` and bias of a 1x1 convolution, for inputs whose last axis is the channels.
    pub(crate) fn as_linear(&self) -> (Tensor, Option<Tensor>) {
        (self.weight.flatten(1, -1), self.bias.as_ref().map(Tensor::shallow_clone))
    }

    /// What a padded 3x3 convolution does to single pixels, `[N, in]` to `[N, out]`.
    pub(crate) fn middle_tap(&self, x: &Tensor) -> Tensor {
        linear(x, &self.weight.select(3, 1).select(2, 1), self.bias.as_ref())
    }

    /// The same for a CPU, with its weights of this moment.
    pub(crate) fn kernel(&self) -> kernels::Conv {
        kernels::Conv::new(&self.weight, self.bias.as_ref(), self.stride, self.padding)
    }

    fn forward_with(&self, x: &Tensor, weight: &Tensor, bias: Option<&Tensor>) -> Tensor {
        let (stride, padding) = ([self.stride; 2], [self.padding; 2]);
        let y = x.conv2d(weight, bias, stride, padding, [1, 1], 1);
        macs::add(y.numel() * weight.numel() / weight.size()[0] as usize);
        y
    }
}

/// Group normalisation over channels; parameters `weight` and `bias`.
#[derive(Debug)]
pub(crate) struct GroupNorm {
    weight: Tensor,
    bias: Tensor,
    groups: i64,
}

impl GroupNorm {
    pub(crate) fn new(path: &Path<'_>, groups: i64, channels: i64) -> Self {
        Self {
            weight: path.weight("weight", &[channels], Init::Constant(1.0)),
            bias: path.weight("bias", &[channels], Init::Constant(0.0)),
            groups,
        }
    }

    /// What follows a convolution: CELU, then this.
    pub(crate) fn after_celu(&self) -> kernels::After {
        let norm = kernels::Groups::new(self.groups, &self.weight, &self.bias);
        kernels::After { curve: kernels::Curve::Elu, norm: Some(norm) }
    }

    pub(crate) fn forward(&self, x: &Tensor) -> Tensor {
        x.group_norm(self.groups, Some(&self.weight), Some(&self.bias), EPS, true)
    }
}

/// Batch normalisation over channels; parameters `weight`, `bias`, buffers `running_mean`, `running_var`.
#[derive(Debug)]
pub(crate) struct BatchNorm2d {
    weight: Tensor,
    bias: Tensor,
    running_mean: Tensor,
    running_var: Tensor,
    momentum: f64,
}

impl BatchNorm2d {
    pub(crate) fn new(path: &Path<'_>, channels: i64, momentum: f64) -> Self {
        Self {
            weight: path.weight("weight", &[channels], Init::Constant(1.0)),
            bias: path.weight("bias", &[channels], Init::Constant(0.0)),
            running_mean: path.buffer("running_mean", &[channels], 0.0),
            running_var: path.buffer("running_var", &[channels], 1.0),
            momentum,
        }
    }

    /// With `train` the statistics are those of the batch and the running ones move towards them.
    pub(crate) fn forward(&self, x: &Tensor, train: bool) -> Tensor {
        x.batch_norm(
            Some(&self.weight),
            Some(&self.bias),
            Some(&self.running_mean),
            Some(&self.running_var),
            train,
            self.momentum,
            EPS,
            true,
        )
    }

    /// Factor and offset per channel that this layer applies outside training, `[C]` each.
    pub(crate) fn affine(&self) -> (Tensor, Tensor) {
        let factor = &self.weight / (&self.running_var + EPS).sqrt();
        let offset = &self.bias - &self.running_mean * &factor;
        (factor, offset)
    }
}

/// The normalisation of the component networks: batch norm as printed, or group norm (decisions row 12).
#[derive(Debug)]
pub(crate) enum Norm {
    Batch(BatchNorm2d),
    Group(GroupNorm),
}

impl Norm {
    pub(crate) fn forward(&self, x: &Tensor, train: bool) -> Tensor {
        match self {
            Self::Batch(norm) => norm.forward(x, train),
            Self::Group(norm) => norm.forward(x),
        }
    }
}

/// Convolution, normalisation, activation, in that order; a batch norm is folded into the convolution by
/// [`ConvNorm::freeze`].
#[derive(Debug)]
pub(crate) struct ConvNorm {
    pub(crate) conv: Conv2d,
    pub(crate) norm: Norm,
    folded: Option<(Tensor, Tensor)>,
}

impl ConvNorm {
    pub(crate) fn new(conv: Conv2d, norm: Norm) -> Self {
        Self { conv, norm, folded: None }
    }

    /// The convolution and its normalisation, no activation.
    pub(crate) fn forward(&self, x: &Tensor, train: bool) -> Tensor {
        match &self.folded {
            Some((weight, bias)) => self.conv.forward_with(x, weight, Some(bias)),
            None => self.norm.forward(&self.conv.forward(x), train),
        }
    }

    /// The same for a CPU, if the norm is folded.
    pub(crate) fn kernel(&self) -> Option<kernels::Conv> {
        let (weight, bias) = self.folded.as_ref()?;
        let Conv2d { stride, padding, .. } = self.conv;
        Some(kernels::Conv::new(weight, Some(bias), stride, padding))
    }

    /// Folds a batch norm into the convolution, with the running statistics of this moment.
    pub(crate) fn freeze(&mut self) {
        if let Norm::Batch(norm) = &self.norm {
            let _no_grad = tch::no_grad_guard();
            let (factor, offset) = norm.affine();
            let weight = &self.conv.weight * factor.view([-1, 1, 1, 1]);
            let bias = match &self.conv.bias {
                Some(bias) => bias * factor + offset,
                None => offset,
            };
            self.folded = Some((weight, bias));
        }
    }
}

/// Sub-pixel enlargement: a convolution to `outputs * factor²` channels, pixel shuffle, activation and,
/// if asked for, a group norm.
#[derive(Debug)]
pub(crate) struct SubPixelConv {
    conv: Conv2d,
    norm: Option<GroupNorm>,
    factor: i64,
}

impl SubPixelConv {
    pub(crate) fn new(conv: Conv2d, norm: Option<GroupNorm>, factor: i64) -> Self {
        Self { conv, norm, factor }
    }

    /// The same for a CPU, if it has a norm.
    pub(crate) fn kernel(&self) -> Option<kernels::Layer> {
        let after = self.norm.as_ref()?.after_celu();
        Some(kernels::Layer::enlarge(
            &self.conv.weight,
            self.conv.bias.as_ref(),
            self.factor,
            after,
        ))
    }

    pub(crate) fn forward(&self, x: &Tensor) -> Tensor {
        let x = self.conv.forward(x).pixel_shuffle(self.factor);
        let x = Activation::Celu.apply(&x);
        match &self.norm {
            Some(norm) => norm.forward(&x),
            None => x,
        }
    }
}
