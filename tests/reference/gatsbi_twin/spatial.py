"""Spatial transformer and boxes.

Positions are `(s_x, s_y, t_x, t_y)`: size as a fraction of the image, centre in [-1, 1], x right and y down.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def _grids(scale: Tensor, shift: Tensor, height: int, width: int) -> Tensor:
    """Sampling grids [M, height, width, 2] of scale and shift [M, 2]."""
    theta = torch.cat([torch.diag_embed(scale), shift.unsqueeze(-1)], -1)  # [M, 2, 3]
    return F.affine_grid(theta, [theta.shape[0], 1, height, width], align_corners=False)


def crop(image: Tensor, place: Tensor, size: int) -> Tensor:
    """Glimpses [B, N, C, size, size] of image [B, C, H, W] at place [B, N, 4]."""
    batch, count = place.shape[:2]
    scale, shift = place.flatten(0, 1).split(2, -1)
    grids = _grids(scale, shift, size, size).reshape(batch, count * size, size, 2)
    glimpses = F.grid_sample(image, grids, align_corners=False)  # [B, C, N size, size]
    return glimpses.unflatten(2, (count, size)).transpose(1, 2)


def paste(glimpses: Tensor, place: Tensor, size: int) -> Tensor:
    """Images [B, N, C, size, size], zero outside place [B, N, 4], of glimpses [B, N, C, g, g]."""
    batch, count = place.shape[:2]
    scale, shift = place.flatten(0, 1).split(2, -1)
    inverse = 1 / (scale + 1e-9)
    grids = _grids(inverse, -shift * inverse, size, size)
    return F.grid_sample(glimpses.flatten(0, 1), grids, align_corners=False).unflatten(0, (batch, count))


def cell_centres(grid: int, like: Tensor) -> Tensor:
    """Centres `(x, y)` of the cells of a grid, row by row, [grid * grid, 2]."""
    line = 2 / grid * (torch.arange(grid, dtype=like.dtype, device=like.device) + 0.5) - 1
    y, x = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([x, y], -1).flatten(0, 1)


def intersection_over_union(a: Tensor, b: Tensor) -> Tensor:
    """[B, N, M] of boxes a [B, N, 4] and b [B, M, 4]."""

    def corners(place: Tensor) -> tuple[Tensor, Tensor]:
        size, centre = place[..., :2], (place[..., 2:] + 1) / 2
        return centre - size / 2, centre + size / 2

    (a_low, a_high), (b_low, b_high) = corners(a.unsqueeze(2)), corners(b.unsqueeze(1))
    overlap = (torch.minimum(a_high, b_high) - torch.maximum(a_low, b_low)).clamp(min=0).prod(-1)
    area_a, area_b = ((high - low).clamp(min=0).prod(-1) for low, high in ((a_low, a_high), (b_low, b_high)))
    overlap = overlap * ((area_a > 0) & (area_b > 0))
    return overlap / (area_a + area_b - overlap + 1e-5)
