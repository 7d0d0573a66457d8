"""The latent vector of an object, the distributions it is drawn from, and the KLs that have no closed class."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .config import ObjectConfig, TrackingConfig, UpdateConfig
from .layers import Mlp, Normal, positive
from .noise import Noise

UNIFORM_EDGE = 2.0**-23


@dataclass
class ObjectLatents:
    """The parts of a latent vector, in its order."""

    pres: Tensor
    """Presence in [0, 1], [..., 1]."""
    depth: Tensor
    """Depth, smaller is nearer, [..., 1]."""
    where: Tensor
    """`(s_x, s_y, t_x, t_y)`, [..., 4]."""
    what: Tensor
    """Appearance, [..., z_what]."""
    dyna: Tensor
    """Dynamics, [..., z_dyna]."""

    def join(self) -> Tensor:
        """The vector, [..., Z]."""
        return torch.cat([self.pres, self.depth, self.where, self.what, self.dyna], -1)

    @classmethod
    def split(cls, z: Tensor, config: ObjectConfig) -> ObjectLatents:
        """The parts of z [..., Z]."""
        return cls(*z.split((1, 1, 4, config.z_what, config.z_dyna), -1))


def draw_presence(probability: Tensor, uniform: Tensor) -> Tensor:
    """Relaxed Bernoulli of temperature 1."""

    def logit(x: Tensor) -> Tensor:
        x = x.clamp(UNIFORM_EDGE, 1 - UNIFORM_EDGE)
        return x.log() - (-x).log1p()

    return (logit(uniform) + logit(probability)).sigmoid()


def presence_kl(probability: Tensor, prior: float) -> Tensor:
    """Bernoulli KL per element against a constant prior probability."""
    eps = 1e-15
    prior = torch.tensor(prior, dtype=probability.dtype, device=probability.device)
    absent, prior_absent = 1 - probability, 1 - prior
    return probability * ((probability + eps).log() - (prior + eps).log()) + absent * (
        (absent + eps).log() - (prior_absent + eps).log()
    )


@dataclass
class Attributes:
    """Distributions of a step's changes of objects."""

    presence: Tensor
    """Probability that the object is present in this frame, [B, N, 1]."""
    depth: Normal
    where: Normal
    what: Normal
    gates: tuple[Tensor, Tensor, Tensor]
    """In (0, 1), of depth, where and what."""


class AttributeNet(nn.Module):
    """Dynamics latent to the changes of depth, where and what; the same while observing and imagining."""

    def __init__(self, config: ObjectConfig) -> None:
        super().__init__()
        what, hidden = config.z_what, config.hidden
        self.sizes = (1, 1, 1, 4, 4, what, what, 1, 4, what)
        self.enc = Mlp([config.z_dyna, hidden, hidden, sum(self.sizes)])

    def forward(self, dyna: Tensor) -> Attributes:
        """dyna [B, N, z_dyna]."""
        presence, depth, depth_scale, where, where_scale, what, what_scale, *gates = self.enc(dyna).split(
            self.sizes, -1
        )
        return Attributes(
            presence.sigmoid(),
            Normal(depth, positive(depth_scale)),
            Normal(where, positive(where_scale)),
            Normal(what, positive(what_scale)),
            tuple(gate.sigmoid() for gate in gates),
        )


def advance(
    previous: ObjectLatents,
    dyna: Tensor,
    attributes: Attributes,
    updates: UpdateConfig,
    tracking: TrackingConfig,
    noise: Noise,
) -> ObjectLatents:
    """The latents after a step; presence is left as it was.

    Sizes and centres move by bounded amounts, depth freely.
    """
    depth_gate, where_gate, what_gate = attributes.gates
    move = where_gate * attributes.where.draw(noise["where"]).tanh()
    scale = previous.where[..., :2] + updates.scale * move[..., :2]
    if tracking.scale_bounds is not None:
        scale = scale.clamp(*tracking.scale_bounds)
    shift = previous.where[..., 2:] + updates.shift * move[..., 2:]
    depth = previous.depth + updates.depth * depth_gate * attributes.depth.draw(noise["depth"])
    what = previous.what + updates.what * what_gate * attributes.what.draw(noise["what"]).tanh()
    return ObjectLatents(previous.pres, depth, torch.cat([scale, shift], -1), what, dyna)


class DynamicsNet(nn.Module):
    """MLP `enc` to the distribution of the dynamics latent."""

    def __init__(self, inputs: int, config: ObjectConfig) -> None:
        super().__init__()
        self.enc = Mlp([inputs, config.hidden, config.hidden, 2 * config.z_dyna])

    def forward(self, *inputs: Tensor) -> Normal:
        """[B, N, ...] each, concatenated."""
        mean, scale = self.enc(torch.cat(inputs, -1)).chunk(2, -1)
        return Normal(mean, positive(scale))


def neighbourhood(distance: Tensor, sigma: float) -> Tensor:
    """Normalised two-dimensional Gaussian density of distance [..., 2], [...]."""
    return (-distance.square().sum(-1) / (2 * sigma**2)).exp() / (2 * math.pi * sigma**2)
