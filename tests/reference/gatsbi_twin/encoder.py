"""Encoder of frames, and of `mu_mix` with the same weights."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from .config import EncoderConfig


class FrameEncoder(nn.Module):
    """Halving convolutions with CELU and group norm, then a linear layer without activation."""

    def __init__(self, config: EncoderConfig, image_size: int) -> None:
        super().__init__()
        self.conv = nn.ModuleList()
        self.norm = nn.ModuleList()
        inputs, kernel = 3, config.first_kernel
        for channels, groups in zip(config.channels, config.groups, strict=True):
            self.conv.append(nn.Conv2d(inputs, channels, kernel, 2, kernel // 2))
            self.norm.append(nn.GroupNorm(groups, channels))
            inputs, kernel = channels, 3
        side = image_size >> len(config.channels)
        self.output = nn.Linear(inputs * side**2, config.features)

    def forward(self, image: Tensor) -> Tensor:
        """[B, 3, H, W] to [B, features]."""
        for conv, norm in zip(self.conv, self.norm, strict=True):
            image = norm(F.celu(conv(image)))
        return self.output(image.flatten(1))
