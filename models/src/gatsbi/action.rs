//! Action enhancement: the one view of the action that every module shares.

use tch::Tensor;

use crate::{
    config::{ActionConfig, InitScheme},
    nn::{Mlp, Path},
};

/// `a_t [B, A]` to the enhanced action `ā_t [B, enhanced]`: MLP with two hidden layers (paper table "MLP act").
#[derive(Debug)]
pub struct ActionEnhancer {
    mlp: Mlp,
}

impl ActionEnhancer {
    /// Creates the parameters under `path`.
    pub fn new(path: &Path<'_>, config: &ActionConfig, scheme: InitScheme) -> Self {
        let widths = [config.dim, config.hidden, config.hidden, config.enhanced];
        Self { mlp: Mlp::new(path, &widths, scheme) }
    }

    /// The enhanced action of a scaled action.
    pub fn forward(&self, action: &Tensor) -> Tensor {
        self.mlp.forward(action)
    }
}
