"""Identities by colour: a known object that the frame does not show where it is thought to be is lost, and what is found
in its colour near it takes its place."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .spatial import crop

MIDDLE, SAMPLES = 0.3, 3
"""A box's colour is the mean of so many samples a side over this share of it."""
IN_MIND = 0.51
"""Presence of a lost object that nothing has taken the place of."""


@dataclass
class Known:
    """The objects that are known in a frame."""

    z: Tensor
    """Propagated, [B, N, Z]."""
    before: Tensor
    """A frame earlier, [B, N, Z]."""
    ids: Tensor
    """[B, N]."""
    colours: Tensor
    """That they are drawn in, [B, N, 3]."""
    frame: Tensor
    unlike: float
    """Colours farther apart are of different objects."""

    def visible(self) -> Tensor:
        """[B, N, Z] in which those are absent that the frame does not show."""
        lost = _apart(self.colours, shown(self.frame, self.z)) > self.unlike**2
        return without(self.z, lost & (self.ids >= 0))

    def same_colour(self, others: Tensor) -> Tensor:
        """Whether the frame has the colour of object n where others [B, M, Z] are, [B, M, N]."""
        return self._strangeness(others) < 1

    def bare(self, others: Tensor, mu_mix: Tensor) -> Tensor:
        """Whether the frame shows only the background where others [B, M, Z] are, [B, M]."""
        return _apart(shown(self.frame, others), shown(mu_mix, others)) <= self.unlike**2

    def reunited(self, found: Tensor, visible: Tensor, reach: float) -> tuple[Tensor, Tensor]:
        """The known objects after each lost one has been given what is most likely it, and the finds that are left.

        It may be given a find, or an object that has been known for less time than itself.
        """
        batch, finds, _ = found.shape
        there = torch.cat([found, visible], 1)
        youth = torch.cat([self.ids.new_full((batch, finds), torch.iinfo(torch.int64).max), self.ids], 1)
        lost = (visible[..., 0] <= 0.5) & (self.ids >= 0)
        distance = _apart(there[:, :, None, 4:6], self.z[:, None, :, 4:6]) / reach**2
        strangeness = self._strangeness(there)
        possible = (youth[:, :, None] > self.ids[:, None]) & (there[..., 0] > 0.5)[:, :, None] & lost[:, None]
        possible &= (strangeness < 1) & (distance < 1)
        price = torch.where(possible, strangeness + distance, torch.inf).detach()
        least, choice = price.min(1)
        favourite = price.argmin(2).gather(1, choice) == torch.arange(choice.shape[1], device=choice.device)
        wanted = favourite & least.isfinite()
        taken = torch.zeros_like(youth).scatter_add(1, choice, wanted.long()) > 0
        rows = torch.arange(batch, device=choice.device)[:, None]
        place = torch.where(wanted[..., None], there[rows, choice], self.z)[..., :6]
        presence = torch.where(lost & ~wanted, place[..., 0].clamp(max=IN_MIND), place[..., 0])
        looks = torch.where(lost[..., None], self.before, self.z)[..., 6:]
        z = torch.cat([presence[..., None], place[..., 1:], looks], -1)
        return without(z, taken[:, finds:]), without(found, taken[:, :finds])

    def _strangeness(self, others: Tensor) -> Tensor:
        return _apart(shown(self.frame, others)[:, :, None], self.colours[:, None]) / self.unlike**2


def drawn(colours: Tensor, alpha: Tensor) -> Tensor:
    """Mean colours [B, N, 3] of glimpses [B, N, 3, g, g] under alpha [B, N, 1, g, g]."""
    return (colours * alpha).sum((-1, -2)) / (alpha.sum((-1, -2)) + 1e-5)


def different(colours: Tensor, unlike: float) -> Tensor:
    """Which pairs of colours [B, N, 3] are of different objects, [B, N, N]."""
    return _apart(colours[:, :, None], colours[:, None]) > unlike**2


def shown(image: Tensor, z: Tensor) -> Tensor:
    """Mean colours [B, N, 3] of an image in the middle of the boxes of z [B, N, Z]."""
    size, centre = z[..., 2:6].detach().split(2, -1)
    return crop(image, torch.cat([size * MIDDLE, centre], -1), SAMPLES).mean((-1, -2))


def without(z: Tensor, which: Tensor) -> Tensor:
    """z [B, N, Z] in which those marked in which [B, N] are absent."""
    return torch.cat([torch.where(which, 0, z[..., 0]).unsqueeze(-1), z[..., 1:]], -1)


def _apart(a: Tensor, b: Tensor) -> Tensor:
    return (a - b).square().sum(-1)
