//! The residual update of latents (supplement, equation "residual"; mixture spec 3, lines 6 and 10).

use tch::Tensor;

use crate::{
    config::MixtureConfig,
    nn::{Activation, InitScheme, Mlp, Path},
};

/// `z_t = z_{t-1} + Δ MLP_res([z̄_t, z_{t-1}])`, and `z_t = z̄_t` on a row's first frame.
#[derive(Debug)]
pub(crate) struct ResidualUpdate {
    mlp: Mlp,
    delta: f64,
}

impl ResidualUpdate {
    pub(crate) fn new(path: &Path<'_>, config: &MixtureConfig, z: i64) -> Self {
        // A small last layer starts latents as nearly constant in time.
        let last_scale = match config.init {
            InitScheme::Framework => 1.0,
            InitScheme::Orthogonal => 0.25,
        };
        let widths = [2 * z, config.mlp, config.mlp, config.mlp, z];
        let mlp = Mlp::with(path, &widths, Activation::Celu, config.init, last_scale);
        Self { mlp, delta: config.delta }
    }

    /// Updated latents and the residual `Δ MLP_res`, both of the shape `[..., z]` of the latents; `first` is
    /// a bool tensor that broadcasts to it.
    pub(crate) fn forward(
        &self,
        z_bar: &Tensor,
        z_previous: &Tensor,
        first: &Tensor,
    ) -> (Tensor, Tensor) {
        let residual = self.mlp.forward(&Tensor::cat(&[z_bar, z_previous], -1)) * self.delta;
        let updated = z_previous + &residual;
        (z_bar.where_self(first, &updated), residual)
    }
}
