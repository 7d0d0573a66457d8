"""Discovery of new objects, one candidate per cell of a grid, and the rejection of those already tracked."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .config import ObjectConfig
from .image_encoder import ImageEncoder
from .latents import ObjectLatents, draw_presence, neighbourhood
from .layers import Mlp, Normal, positive
from .noise import Noise
from .spatial import cell_centres, intersection_over_union


@dataclass
class Discovered:
    """Candidates of all cells."""

    latents: ObjectLatents
    """After rejection, [B, G * G, ...]."""
    sampled_presence: Tensor
    """Before rejection, [B, G * G, 1]."""
    presence: Tensor
    """Probability of an object, [B, G * G, 1]."""
    depth: Normal
    raw_where: Normal
    """Before sigmoid and tanh."""
    what: Normal
    dyna: Normal


class CellHead(nn.Module):
    """1x1 convolutions with CELU and group norm from features to numbers per cell."""

    def __init__(self, hidden: int, outputs: int) -> None:
        super().__init__()
        self.enc = nn.Sequential(
            nn.Conv2d(2 * hidden, hidden, 1),
            nn.CELU(),
            nn.GroupNorm(8, hidden),
            nn.Conv2d(hidden, hidden, 1),
            nn.CELU(),
            nn.GroupNorm(8, hidden),
            nn.Conv2d(hidden, outputs, 1),
        )

    def forward(self, features: Tensor) -> Tensor:
        """[B, 2 hidden, G, G] to [B, G * G, outputs], row by row."""
        return self.enc(features).flatten(2).transpose(1, 2)


class Discovery(nn.Module):
    """Networks of discovery."""

    def __init__(self, config: ObjectConfig, image_size: int) -> None:
        super().__init__()
        what, dyna, hidden = config.z_what, config.z_dyna, config.hidden
        self.image_encoder = ImageEncoder(config, image_size)
        self.map = Mlp([config.z_width, hidden, hidden, hidden])
        self.dyna_head = CellHead(hidden, 2 * dyna)
        # The attribute head ends in numbers for a dynamics latent that nothing reads.
        self.sizes = (1, 1, 1, 4, 4, what, what, 2 * dyna)
        self.attribute_head = CellHead(hidden, sum(self.sizes))
        self.config = config

    def forward(
        self,
        frame: Tensor,
        difference: Tensor,
        known: ObjectLatents,
        noise: Noise,
        alike: Callable[[Tensor], Tensor] | None = None,
    ) -> Discovered:
        """Candidates of frame [B, 3, H, W], its difference from the background, and tracked objects [B, N, ...].

        `alike` tells of latent vectors [B, G * G, Z] which tracked objects' colour they have, [B, G * G, N]; a candidate of
        another colour than the object that covers it is not rejected.
        """
        features = self.image_encoder(torch.cat([frame, difference], 1))
        features = torch.cat([features, self._known_map(known)], 1)
        dyna, dyna_scale = self.dyna_head(features).chunk(2, -1)
        presence, depth, depth_scale, where, where_scale, what, what_scale, _ = self.attribute_head(
            features
        ).split(self.sizes, -1)
        found = Discovered(
            latents=known,
            sampled_presence=presence,
            presence=presence.sigmoid(),
            depth=Normal(depth, positive(depth_scale)),
            raw_where=Normal(where, positive(where_scale)),
            what=Normal(what, positive(what_scale)),
            dyna=Normal(dyna, positive(dyna_scale)),
        )
        found.sampled_presence = draw_presence(found.presence, noise["discovery_presence"])
        place = self._absolute(found.raw_where.draw(noise["discovery_where"]))
        found.latents = ObjectLatents(
            found.sampled_presence,
            found.depth.draw(noise["discovery_depth"]),
            place,
            found.what.draw(noise["discovery_what"]),
            found.dyna.draw(noise["discovery_dynamics"]),
        )
        same = None if alike is None else alike(found.latents.join())
        found.latents.pres = self._reject(found.sampled_presence, place, known, same)
        return found

    def _known_map(self, known: ObjectLatents) -> Tensor:
        """What is tracked near each cell, [B, hidden, G, G]."""
        centres = cell_centres(self.config.grid, known.where)  # [G * G, 2]
        distance = centres[:, None] - known.where[..., None, :, 2:]  # [B, G * G, N, 2]
        nearness = neighbourhood(distance, self.config.updates.map_sigma) * known.pres.transpose(1, 2)
        cells = nearness @ self.map(known.join())  # [B, G * G, hidden]
        return cells.transpose(1, 2).unflatten(2, (self.config.grid, self.config.grid))

    def _absolute(self, raw: Tensor) -> Tensor:
        """Position in the image of raw where [B, G * G, 4]."""
        centres = cell_centres(self.config.grid, raw)
        shift = 2 / self.config.grid * raw[..., 2:].tanh() + centres
        return torch.cat([raw[..., :2].sigmoid(), shift], -1)

    def _reject(self, presence: Tensor, place: Tensor, known: ObjectLatents, same: Tensor | None) -> Tensor:
        """Presence [B, G * G, 1], zero where a present tracked object, of the same colour, covers the candidate."""
        threshold = math.inf if self.config.rejection is None else self.config.rejection
        overlap = intersection_over_union(place.detach(), known.where.detach())  # [B, G * G, N]
        taken = (overlap > threshold) & (known.pres > 0.5).transpose(1, 2)
        if same is not None:
            taken = taken & same
        return presence * ~taken.any(2, keepdim=True)
