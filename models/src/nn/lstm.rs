//! LSTM cells: one, or a bank of K with weights of their own. Gate order input, forget, cell, output.

use tch::Tensor;

use super::{
    Path, macs,
    params::{Init, InitScheme},
};

/// One LSTM cell with the parameter names and the two bias vectors that `PyTorch` gives it.
#[derive(Debug)]
pub(crate) struct LstmCell {
    weight_ih: Tensor,
    weight_hh: Tensor,
    bias_ih: Tensor,
    bias_hh: Tensor,
}

impl LstmCell {
    pub(crate) fn new(path: &Path<'_>, inputs: i64, hidden: i64) -> Self {
        let init = Init::Uniform { bound: 1.0 / (hidden as f64).sqrt() };
        Self {
            weight_ih: path.weight("weight_ih", &[4 * hidden, inputs], init),
            weight_hh: path.weight("weight_hh", &[4 * hidden, hidden], init),
            bias_ih: path.weight("bias_ih", &[4 * hidden], init),
            bias_hh: path.weight("bias_hh", &[4 * hidden], init),
        }
    }

    /// # Shapes
    /// `x [B, inputs]`, state `(h, c)` of `[B, hidden]` each; returns the next state.
    pub(crate) fn forward(&self, x: &Tensor, (h, c): (&Tensor, &Tensor)) -> (Tensor, Tensor) {
        let batch = x.size()[0] as usize;
        macs::add(batch * (self.weight_ih.numel() + self.weight_hh.numel()));
        x.lstm_cell(
            &[h, c],
            &self.weight_ih,
            &self.weight_hh,
            Some(&self.bias_ih),
            Some(&self.bias_hh),
        )
    }
}

/// K LSTM cells that run side by side, each with its own weights (mixture spec 2.4): one batched product.
///
/// Parameters `weight [K, inputs + hidden, 4 hidden]` and `bias [K, 4 hidden]`.
#[derive(Debug)]
pub(crate) struct LstmBank {
    weight: Tensor,
    bias: Tensor,
    hidden: i64,
}

impl LstmBank {
    pub(crate) fn new(path: &Path<'_>, cells: i64, inputs: i64, hidden: i64) -> Self {
        let init = Init::Uniform { bound: 1.0 / (hidden as f64).sqrt() };
        let bias = path.weight("bias", &[cells, 4 * hidden], Init::Constant(0.0));
        // An open forget gate at the start lets gradients reach far back (Jozefowicz et al. 2015).
        let _no_grad = tch::no_grad_guard();
        let _ = bias.narrow(1, hidden, hidden).fill_(1.0);
        Self {
            weight: path.weight("weight", &[cells, inputs + hidden, 4 * hidden], init),
            bias,
            hidden,
        }
    }

    /// # Shapes
    /// `x [B, K, inputs]`, state `(h, c)` of `[B, K, hidden]` each; returns the next state.
    pub(crate) fn forward(&self, x: &Tensor, (h, c): (&Tensor, &Tensor)) -> (Tensor, Tensor) {
        macs::add(x.size()[0] as usize * self.weight.numel());
        let joined = Tensor::cat(&[x, h], -1).transpose(0, 1); // [K, B, inputs + hidden]
        let gates = self.bias.unsqueeze(1).baddbmm(&joined, &self.weight, 1.0, 1.0); // [K, B, 4 hidden]
        let gates = gates.transpose(0, 1); // [B, K, 4 hidden]
        let gate = |i: i64| gates.narrow(-1, i * self.hidden, self.hidden);
        let c = gate(1).sigmoid() * c + gate(0).sigmoid() * gate(2).tanh();
        let h = gate(3).sigmoid() * c.tanh();
        (h, c)
    }
}

/// A learned initial state, shared by the rows of a batch.
#[derive(Debug)]
pub(crate) struct LearnedState {
    /// Hidden state without a batch axis.
    pub(crate) h: Tensor,
    /// Cell state without a batch axis.
    pub(crate) c: Tensor,
}

impl LearnedState {
    /// How learned constants start: at zero, or from N(0, 1), which makes slots differ from the start.
    pub(crate) fn init(scheme: InitScheme) -> Init {
        match scheme {
            InitScheme::Framework => Init::Constant(0.0),
            InitScheme::Orthogonal => Init::Normal { std: 1.0 },
        }
    }

    /// `shape` is the state's without the batch axis.
    pub(crate) fn new(path: &Path<'_>, shape: &[i64], scheme: InitScheme) -> Self {
        let init = Self::init(scheme);
        Self { h: path.weight("h", shape, init), c: path.weight("c", shape, init) }
    }

    /// The state for `batch` rows.
    pub(crate) fn expand(&self, batch: i64) -> (Tensor, Tensor) {
        let mut shape = vec![batch];
        shape.extend(self.h.size());
        (self.h.unsqueeze(0).expand(&shape, false), self.c.unsqueeze(0).expand(&shape, false))
    }
}
