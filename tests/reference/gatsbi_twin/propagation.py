"""Propagation of known objects: into an observed frame (posterior) or onwards without one (prior)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .config import ObjectConfig, TrackingConfig
from .glimpses import GlimpseEncoder
from .latents import AttributeNet, Attributes, DynamicsNet, ObjectLatents, advance, draw_presence
from .layers import Mlp, Normal
from .noise import Noise
from .spatial import crop


@dataclass
class Propagated:
    """Objects tracked into a frame."""

    latents: ObjectLatents
    """[B, N, ...]."""
    proposal: Tensor
    """Windows they were looked for in, [B, N, 4]."""
    dyna: Normal
    """Posterior of the dynamics latents."""
    dyna_prior: Normal
    """Their prior."""
    attributes: Attributes


class Propagation(nn.Module):
    """Networks of propagation."""

    def __init__(self, config: ObjectConfig) -> None:
        super().__init__()
        hidden = config.hidden
        self.proposal = Mlp([hidden, hidden, hidden, 2])
        self.proposal_encoder = GlimpseEncoder(config)
        self.posterior = DynamicsNet(2 * hidden, config)
        self.prior = DynamicsNet(hidden, config)
        self.attributes = AttributeNet(config)
        self.config = config

    def observe(
        self,
        z: Tensor,
        h_post: Tensor,
        h_prior: Tensor,
        frame: Tensor,
        noise: Noise,
        tracking: TrackingConfig,
    ) -> Propagated:
        """Tracks objects z [B, N, Z] with memories h [B, N, hidden] into frame [B, 3, H, W]."""
        updates = self.config.updates
        previous = ObjectLatents.split(z, self.config)
        least, most = updates.proposal
        enlargement = least + (most - least) * self.proposal(h_post).sigmoid()
        proposal = torch.cat([previous.where[..., :2] + enlargement, previous.where[..., 2:]], -1)
        seen = self.proposal_encoder(crop(frame, proposal, self.config.glimpse))
        dyna = self.posterior(seen, h_post)
        sample = dyna.draw(noise["dynamics"])
        attributes = self.attributes(sample)
        latents = advance(previous, sample, attributes, updates, tracking, noise)
        now = draw_presence(attributes.presence, noise["presence"])
        latents.pres = previous.pres * now
        if tracking.presence == "hold":
            held = (now > 0.5) & (previous.pres > 0.5)
            latents.pres = torch.where(held, torch.ones_like(now), latents.pres)
        return Propagated(latents, proposal, dyna, self.prior(h_prior), attributes)

    def imagine(self, z: Tensor, h_prior: Tensor, noise: Noise, tracking: TrackingConfig) -> Tensor:
        """Objects z [B, N, Z] one step on, [B, N, Z]; presence stays."""
        sample = self.prior(h_prior).draw(noise["dynamics"])
        previous = ObjectLatents.split(z, self.config)
        attributes = self.attributes(sample)
        return advance(previous, sample, attributes, self.config.updates, tracking, noise).join()
