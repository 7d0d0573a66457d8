"""Likelihoods and penalties of the objective, [B] each."""

from __future__ import annotations

import math

from torch import Tensor

from .layers import Normal
from .mixture import MixtureStep


def _sum(x: Tensor) -> Tensor:
    return x.flatten(1).sum(1)


def log_density(x: Tensor, mean: Tensor, sigma: float) -> Tensor:
    """log N(x | mean, sigma squared) per element."""
    return -0.5 * ((x - mean) / sigma).square() - math.log(sigma) - 0.5 * math.log(2 * math.pi)


def gaussian_log_likelihood(frame: Tensor, image: Tensor, sigma: float) -> Tensor:
    """One Gaussian per pixel and channel; frame and image [B, 3, H, W]."""
    return _sum(log_density(frame, image, sigma))


def mixture_log_likelihood(frame: Tensor, log_masks: Tensor, components: Tensor, sigma: float) -> Tensor:
    """A mixture over slots per pixel and channel.

    frame [B, 3, H, W]; log_masks [B, K, 1, H, W]; components [B, K, 3, H, W].
    """
    return _sum((log_masks + log_density(frame.unsqueeze(1), components, sigma)).logsumexp(1))


def latent_kl(posterior: Normal, prior: Normal) -> Tensor:
    """KL summed over slots and dimensions."""
    return _sum(posterior.kl(prior))


def residual_norm(step: MixtureStep, first: Tensor) -> Tensor:
    """Norms of the residual steps of masks and components, summed over slots; 0 on a row's first frame."""
    norms = [(x.square().sum(-1) + 1e-12).sqrt().sum(1) for x in (step.masks.residual, step.comps.residual)]
    return (norms[0] + norms[1]) * ~first


def keypoint_regression(gamma: Tensor, agent_mask: Tensor) -> Tensor:
    """Squared difference of the keypoint map and the agent's mask, [B, 1, H, W] each."""
    return _sum((gamma - agent_mask).square())


def fixed_alpha_image(foreground: Tensor, mu_mix: Tensor, alpha: float) -> Tensor:
    """The composite while alpha is a constant."""
    return foreground + (1 - alpha) * mu_mix
