"""Noise as an argument: one tensor per place of a step at which noise enters, by name.

The model draws nothing. `SITES` lists the places with their shapes and kinds; a step reads those it needs.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from .config import GatsbiConfig

Noise = Mapping[str, Tensor]

UNIFORM = ("presence", "discovery_presence")
"""Sites of uniform noise in (0, 1); all others are standard normal."""

PROPAGATION = ("dynamics", "presence", "depth", "where", "what")
DISCOVERY = (
    "discovery_dynamics",
    "discovery_presence",
    "discovery_depth",
    "discovery_where",
    "discovery_what",
)


def shapes(config: GatsbiConfig) -> dict[str, tuple[int, int]]:
    """Shape of each site without the batch."""
    mixture, objects = config.mixture, config.objects
    widths = (objects.z_dyna, 1, 1, 4, objects.z_what)
    sites = {"mask": (mixture.slots, mixture.z_mask), "component": (mixture.slots, mixture.z_comp)}
    sites |= {site: (objects.max_objects, width) for site, width in zip(PROPAGATION, widths, strict=True)}
    sites |= {site: (objects.grid**2, width) for site, width in zip(DISCOVERY, widths, strict=True)}
    return sites


def mean(config: GatsbiConfig, batch: int) -> dict[str, Tensor]:
    """Noise under which every distribution gives its mean: normal 0, uniform 1/2."""
    return {
        site: torch.full((batch, *shape), 0.5 if site in UNIFORM else 0.0)
        for site, shape in shapes(config).items()
    }


def sample(config: GatsbiConfig, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Noise drawn from `generator`."""
    noise = {}
    for site, shape in shapes(config).items():
        draw = torch.rand if site in UNIFORM else torch.randn
        noise[site] = draw(batch, *shape, generator=generator)
    return noise
