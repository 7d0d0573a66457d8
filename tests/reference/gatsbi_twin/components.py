"""Component latents, all slots at once, and the two forms of their decoder."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .config import MixtureConfig
from .layers import Mlp, Normal, bounded_normal, component_norm, enlarging_stages, fit, over_slots
from .residual import ResidualUpdate


@dataclass
class CompLatents:
    """Latents of all slots, [B, K, z_comp] each."""

    z: Tensor
    """After the residual update."""
    raw: Normal
    """Distribution before it."""
    residual: Tensor
    """Delta times the residual network."""


class CompEncoder(nn.Module):
    """Frame and log mask to features: halving convolutions, norm, ELU, then a linear layer."""

    def __init__(self, config: MixtureConfig, image_size: int) -> None:
        super().__init__()
        channels = config.comp_encoder.channels
        self.conv = nn.ModuleList(
            nn.Conv2d(i, o, 3, 2, 1) for i, o in zip([4, *channels[:-1]], channels, strict=True)
        )
        self.norm = nn.ModuleList(component_norm(config.comp_norm, width) for width in channels)
        side = image_size >> len(channels)
        self.output = nn.Linear((channels or [4])[-1] * side**2, config.comp_encoder.features)

    def forward(self, x: Tensor) -> Tensor:
        """[B, 4, H, W] to [B, features]."""
        for conv, norm in zip(self.conv, self.norm, strict=True):
            x = F.elu(norm(conv(x)))
        return self.output(x.flatten(1))


class CompPath(nn.Module):
    """Posterior and prior of the component latents."""

    def __init__(self, config: MixtureConfig, action: int, image_size: int) -> None:
        super().__init__()
        z, h, mlp = config.z_comp, config.hidden, config.mlp
        self.encoder = CompEncoder(config, image_size)
        self.history = Mlp([config.comp_encoder.features + h, mlp, mlp, mlp])
        self.post_head = Mlp([mlp + action, mlp, mlp, 2 * z])
        seen = config.z_mask + z + h + (action if config.comp_prior_action else 0)
        self.prior_head = Mlp([seen, mlp, mlp, 2 * z], nn.ELU)
        self.residual = ResidualUpdate(config, z)
        self.prior_action = config.comp_prior_action

    def posterior(
        self,
        frame: Tensor,
        log_masks: Tensor,
        memory: Tensor,
        previous: Tensor,
        action: Tensor,
        first: Tensor,
        noise: Tensor,
    ) -> CompLatents:
        """Latents of a frame.

        frame [B, 3, H, W]; log_masks [B, K, 1, H, W]; memory, the posterior's, [B, K, h];
        previous [B, K, z]; action [B, a]; first [B]; noise [B, K, z].
        """
        slots = log_masks.shape[1]
        frames = frame.unsqueeze(1).expand(-1, slots, -1, -1, -1)
        views = torch.cat([frames, (log_masks.exp() + 1e-5).log()], 2)  # [B, K, 4, H, W]
        features = self.history(torch.cat([over_slots(self.encoder, views), memory], -1))
        actions = action.unsqueeze(1).expand(-1, slots, -1)
        raw = bounded_normal(self.post_head(torch.cat([features, actions], -1)))
        return self._latents(raw, previous, first, noise)

    def imagine(
        self, z_mask: Tensor, memory: Tensor, previous: Tensor, action: Tensor, first: Tensor, noise: Tensor
    ) -> CompLatents:
        """Latents from the prior; z_mask [B, K, z_mask], memory the prior's, the rest as in `posterior`."""
        raw = self.prior_of(z_mask, memory, previous, action)
        return self._latents(raw, previous, first, noise)

    def prior_of(self, z_mask: Tensor, memory: Tensor, previous: Tensor, action: Tensor) -> Normal:
        """Prior of the raw latents, [B, K, z]."""
        seen = [z_mask, previous, memory]
        if self.prior_action:
            seen.append(action.unsqueeze(1).expand(-1, z_mask.shape[1], -1))
        return bounded_normal(self.prior_head(torch.cat(seen, -1)))

    def _latents(self, raw: Normal, previous: Tensor, first: Tensor, noise: Tensor) -> CompLatents:
        z, residual = self.residual.update(raw.draw(noise), previous, first[:, None, None])
        return CompLatents(z, raw, residual)


class BroadcastDecoder(nn.Module):
    """A latent spread over an enlarged grid with coordinates, then unpadded convolutions."""

    def __init__(self, config: MixtureConfig, action: int, image_size: int) -> None:
        super().__init__()
        decoder = config.comp_decoder
        width, kernel = decoder.width, decoder.final_kernel
        self.condition = Mlp([config.z_comp + action, config.mlp, config.mlp, decoder.inputs])
        self.conv = nn.ModuleList(nn.Conv2d(i, width, 3) for i in (decoder.inputs + 2, width, width))
        self.norm = nn.ModuleList(component_norm(config.comp_norm, width) for _ in range(3))
        self.output = nn.Conv2d(width, 3, kernel)
        self.side = image_size + 2 * 3 + (kernel - 1)

    def forward(self, x: Tensor) -> Tensor:
        """[B, inputs] to images [B, 3, H, W] in [0, 1]."""
        batch, side = x.shape[0], self.side
        line = torch.linspace(-1, 1, side, dtype=x.dtype, device=x.device)
        grid = torch.stack([line.expand(side, side), line[:, None].expand(side, side)])  # x, then y
        x = torch.cat([x[..., None, None].expand(-1, -1, side, side), grid.expand(batch, 2, side, side)], 1)
        for conv, norm in zip(self.conv, self.norm, strict=True):
            x = F.elu(norm(conv(x)))
        return self.output(x).sigmoid()


class SubPixelDecoder(nn.Module):
    """A linear layer to a small image, then enlarging stages."""

    def __init__(self, config: MixtureConfig, action: int, image_size: int) -> None:
        super().__init__()
        decoder = config.comp_decoder
        self.condition = Mlp([config.z_comp + action, config.mlp, config.mlp, decoder.inputs])
        self.base = nn.Linear(decoder.inputs, decoder.base * decoder.base_side**2)
        self.stages = enlarging_stages(decoder.base, decoder.stages)
        self.output = nn.Conv2d(decoder.stages[-1].channels, 3, 3, padding=1)
        self.base_side = decoder.base_side
        self.image_size = image_size

    def forward(self, x: Tensor) -> Tensor:
        """[B, inputs] to images [B, 3, H, W] in [0, 1]."""
        x = F.celu(self.base(x)).unflatten(1, (-1, self.base_side, self.base_side))
        for stage in self.stages:
            x = stage(x)
        return fit(self.output(x), self.image_size).sigmoid()


def comp_decoder(config: MixtureConfig, action: int, image_size: int) -> BroadcastDecoder | SubPixelDecoder:
    """The decoder that the configuration names."""
    kinds = {"broadcast": BroadcastDecoder, "sub_pixel": SubPixelDecoder}
    return kinds[config.comp_decoder.kind](config, action, image_size)
