"""Residual update of latents: the network's output moves the previous latent, scaled by delta."""

from __future__ import annotations

import torch
from torch import Tensor

from .config import MixtureConfig
from .layers import Mlp


class ResidualUpdate(Mlp):
    """MLP of raw and previous latent with three hidden layers."""

    def __init__(self, config: MixtureConfig, width: int) -> None:
        super().__init__([2 * width, config.mlp, config.mlp, config.mlp, width])
        self.delta = config.delta

    def update(self, raw: Tensor, previous: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        """The latent and the step that led to it, both of the shape of `raw` [..., d].

        On rows where `first` is true there is no previous latent and the raw one is taken as it is.
        """
        step = self.delta * self(torch.cat([raw, previous], -1))
        return torch.where(first, raw, previous + step), step
