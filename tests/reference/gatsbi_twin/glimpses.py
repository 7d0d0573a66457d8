"""Encoder and decoder of glimpses."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from .config import ObjectConfig


class GlimpseEncoder(nn.Module):
    """Halving convolutions, CELU before group norm, then a linear layer."""

    def __init__(self, config: ObjectConfig) -> None:
        super().__init__()
        channels, groups = config.glimpse_encoder.channels, config.glimpse_encoder.groups
        layers: list[nn.Module] = []
        for i, (width, count) in enumerate(zip(channels, groups, strict=True)):
            inputs = channels[i - 1] if i else 3
            layers += [nn.Conv2d(inputs, width, 3, 2, 1), nn.CELU(), nn.GroupNorm(count, width)]
        self.enc = nn.Sequential(*layers)
        side = config.glimpse >> len(channels)
        self.enc_what = nn.Linear((channels or [3])[-1] * side**2, config.hidden)

    def forward(self, glimpses: Tensor) -> Tensor:
        """[B, N, 3, g, g] to [B, N, hidden]."""
        shape = glimpses.shape[:2]
        return self.enc_what(self.enc(glimpses.flatten(0, 1)).flatten(1)).unflatten(0, shape)


class GlimpseDecoder(nn.Module):
    """Appearance latents to colours and alpha: 3x3 convolutions, pixel shuffle, CELU, group norm."""

    def __init__(self, config: ObjectConfig) -> None:
        super().__init__()
        inputs = config.hidden
        self.fc = nn.Linear(config.z_what, inputs)
        layers: list[nn.Module] = []
        for width, count in zip(config.glimpse_decoder.channels, config.glimpse_decoder.groups, strict=True):
            layers += [
                nn.Conv2d(inputs, 4 * width, 3, 1, 1),
                nn.PixelShuffle(2),
                nn.CELU(),
                nn.GroupNorm(count, width),
            ]
            inputs = width
        layers += [nn.Conv2d(inputs, 16, 3, 1, 1), nn.PixelShuffle(2), nn.Sigmoid()]
        self.net = nn.Sequential(*layers)

    def forward(self, what: Tensor) -> tuple[Tensor, Tensor]:
        """what [B, N, z_what] to colours [B, N, 3, g, g] and alpha [B, N, 1, g, g], both in [0, 1]."""
        x = F.celu(self.fc(what)).flatten(0, 1)[..., None, None]
        return self.net(x).unflatten(0, what.shape[:2]).split((3, 1), 2)
