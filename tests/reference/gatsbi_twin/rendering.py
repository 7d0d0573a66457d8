"""Rendering of objects into an image."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .config import ObjectConfig
from .glimpses import GlimpseDecoder
from .latents import ObjectLatents
from .spatial import paste


@dataclass
class Rendering:
    """Objects as an image."""

    foreground: Tensor
    """Premultiplied, [B, 3, H, W]."""
    alpha: Tensor
    """Of all objects together, [B, 1, H, W]."""
    masks: Tensor
    """Share of each object in `alpha`, [B, N, H, W]."""

    def over(self, mu_mix: Tensor) -> Tensor:
        """The whole image on the mixture's, [B, 3, H, W]."""
        return self.foreground + (1 - self.alpha) * mu_mix


def render(decoder: GlimpseDecoder, z: Tensor, config: ObjectConfig, image_size: int) -> Rendering:
    """Draws objects z [B, N, Z]."""
    latents = ObjectLatents.split(z, config)
    colours, alpha = decoder(latents.what)
    alpha = alpha * latents.pres[..., None, None]
    images = paste(torch.cat([alpha * colours, alpha], 2), latents.where, image_size)  # [B, N, 4, H, W]
    colours, alpha = images.split((3, 1), 2)
    importance = alpha * (-latents.depth).sigmoid()[..., None, None]
    importance = importance / (importance.sum(1, keepdim=True) + 1e-5)
    shares = importance * alpha
    return Rendering((importance * colours).sum(1), shares.sum(1), shares.squeeze(2))
