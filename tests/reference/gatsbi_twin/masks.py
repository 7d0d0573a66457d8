"""Mask latents, slot after slot, and their decoder."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .config import MaskDecoderConfig, MixtureConfig
from .layers import LearnedState, Mlp, Normal, bounded_normal, enlarging_stages, fit, over_slots
from .residual import ResidualUpdate


@dataclass
class MaskLatents:
    """Latents of all slots, [B, K, z_mask] each."""

    z: Tensor
    """After the residual update."""
    raw: Normal
    """Distribution before it."""
    residual: Tensor
    """Delta times the residual network."""


class MaskPath(nn.Module):
    """Posterior and prior of the mask latents, autoregressive over slots."""

    def __init__(self, config: MixtureConfig, action: int) -> None:
        super().__init__()
        z, h, mlp, features = config.z_mask, config.hidden, config.mlp, config.mask_features
        image = config.encoder.features
        self.post_first = Mlp([image + h + action, mlp, mlp, features])
        self.post_rest = Mlp([image + h, mlp, mlp, features])
        self.post_chain = nn.LSTMCell(features + z, h)
        self.post_chain_start = LearnedState(h)
        self.post_latent_start = nn.Parameter(torch.empty(z))
        self.post_head = Mlp([h, mlp, mlp, 2 * z])
        self.prior_first = Mlp([z + 2 * h + action, mlp, mlp, features])
        self.prior_rest = Mlp([z + 2 * h, mlp, mlp, features])
        self.prior_chain = nn.LSTMCell(h + z, h)
        self.prior_chain_start = LearnedState(h)
        self.prior_head = Mlp([features, mlp, mlp, 2 * z])
        self.residual = ResidualUpdate(config, z)

    def posterior(
        self, encoding: Tensor, memory: Tensor, previous: Tensor, action: Tensor, first: Tensor, noise: Tensor
    ) -> MaskLatents:
        """Latents of a frame.

        encoding [B, e]; memory, the posterior's, [B, K, h]; previous [B, K, z]; action [B, a]; first [B];
        noise [B, K, z].
        """
        batch, slots, _ = memory.shape
        features_first = self.post_first(torch.cat([encoding, memory[:, 0], action], -1))
        rest = encoding.unsqueeze(1).expand(-1, slots - 1, -1)
        features_rest = self.post_rest(torch.cat([rest, memory[:, 1:]], -1))
        features = [features_first, *features_rest.unbind(1)]  # K x [B, features]
        z = self.post_latent_start.expand(batch, -1)
        state = self.post_chain_start.expand(batch)
        steps = []
        for k in range(slots):
            state = self.post_chain(torch.cat([features[k], z], -1), state)
            raw = bounded_normal(self.post_head(state[0]))
            z, residual = self.residual.update(raw.draw(noise[:, k]), previous[:, k], first[:, None])
            steps.append((z, raw, residual))
        return _stack(steps)

    def imagine(
        self, memory: Tensor, previous: Tensor, action: Tensor, first: Tensor, noise: Tensor
    ) -> MaskLatents:
        """Latents from the prior; shapes as in `posterior`, memory is the prior's."""
        batch, slots, _ = memory.shape
        state = self.prior_chain_start.expand(batch)
        steps = []
        for k in range(slots):
            inputs = [previous[:, k], memory[:, k], state[0]]
            if k == 0:
                features = self.prior_first(torch.cat([*inputs, action], -1))
            else:
                features = self.prior_rest(torch.cat(inputs, -1))
            raw = bounded_normal(self.prior_head(features))
            z, residual = self.residual.update(raw.draw(noise[:, k]), previous[:, k], first[:, None])
            steps.append((z, raw, residual))
            if k + 1 < slots:
                state = self.prior_chain(torch.cat([memory[:, k], z], -1), state)
        return _stack(steps)

    def prior_of(self, z: Tensor, memory: Tensor, previous: Tensor, action: Tensor) -> Normal:
        """Prior of the raw latents of each slot when the earlier slots have the latents `z` [B, K, z]."""
        batch, slots, _ = memory.shape
        state = self.prior_chain_start.expand(batch)
        chain = [state[0]]
        for k in range(slots - 1):
            state = self.prior_chain(torch.cat([memory[:, k], z[:, k]], -1), state)
            chain.append(state[0])
        inputs = torch.cat([previous, memory, torch.stack(chain, 1)], -1)  # [B, K, z + 2 h]
        first = self.prior_first(torch.cat([inputs[:, 0], action], -1))
        features = torch.cat([first.unsqueeze(1), self.prior_rest(inputs[:, 1:])], 1)
        return bounded_normal(self.prior_head(features))


def _stack(steps: list[tuple[Tensor, Normal, Tensor]]) -> MaskLatents:
    z, raw, residual = zip(*steps, strict=True)
    mean = torch.stack([normal.mean for normal in raw], 1)
    std = torch.stack([normal.std for normal in raw], 1)
    return MaskLatents(torch.stack(z, 1), Normal(mean, std), torch.stack(residual, 1))


class MaskDecoder(nn.Module):
    """Mask latents to log masks by stick breaking; the last slot takes what remains."""

    def __init__(self, config: MixtureConfig, action: int, image_size: int) -> None:
        super().__init__()
        decoder: MaskDecoderConfig = config.mask_decoder
        self.condition = Mlp([config.z_mask + action, config.mlp, config.mlp, decoder.inputs])
        self.base = nn.Conv2d(decoder.inputs, decoder.base, 1)
        self.base_norm = nn.GroupNorm(decoder.base_groups, decoder.base)
        self.stages = enlarging_stages(decoder.base, decoder.stages)
        self.output = nn.Conv2d(decoder.stages[-1].channels, 1, 3, padding=1)
        self.image_size = image_size

    def forward(self, z: Tensor, action: Tensor) -> Tensor:
        """z [B, K, z_mask], action [B, a] to log masks [B, K, 1, H, W]."""
        z = z[:, :-1]
        action = action.unsqueeze(1).expand(-1, z.shape[1], -1)
        logits = over_slots(self.logits, self.condition(torch.cat([z, action], -1)))
        return stick_breaking(logits)

    def logits(self, x: Tensor) -> Tensor:
        """[B, inputs] to [B, 1, H, W]."""
        x = self.base_norm(F.celu(self.base(x[..., None, None])))
        for stage in self.stages:
            x = stage(x)
        return fit(self.output(x), self.image_size)


def stick_breaking(logits: Tensor) -> Tensor:
    """Logits [B, K - 1, ...] of "mine, of what is left" to log shares [B, K, ...] that sum to one."""
    mine, left = F.logsigmoid(logits), F.logsigmoid(-logits).cumsum(1)
    scope = torch.cat([torch.zeros_like(left[:, :1]), left], 1)
    return torch.cat([mine, torch.zeros_like(left[:, :1])], 1) + scope
