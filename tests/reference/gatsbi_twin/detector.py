"""Keypoint detector: heatmaps, keypoints, their Gaussian maps, and the keypoint map gamma."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .config import DetectorConfig

STD = 1.5 / 16
"""Standard deviation of a keypoint's Gaussian in the [-1, 1] coordinates of the image, whatever its size."""


def axes(height: int, width: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """x [width] from -1 at the left to 1, y [height] from 1 at the top to -1."""
    x = torch.linspace(-1, 1, width, dtype=like.dtype, device=like.device)
    y = torch.linspace(1, -1, height, dtype=like.dtype, device=like.device)
    return x, y


class Detector(nn.Module):
    """Frames to keypoints `(x, y up, strength)`."""

    def __init__(self, config: DetectorConfig, image_size: int) -> None:
        super().__init__()
        self.conv = nn.ModuleList()
        inputs = 5
        for scale in range(3):
            outputs = config.filters * 2**scale
            for i in range(1 + config.convs_per_scale):
                stride = 2 if scale > 0 and i == 0 else 1
                self.conv.append(nn.Conv2d(inputs, outputs, 3, stride, padding=1))
                inputs = outputs
        self.output = nn.Conv2d(inputs, config.keypoints, 1)
        self.config = config
        self.image_size = image_size

    def heatmaps(self, frame: Tensor) -> Tensor:
        """frame [B, 3, H, W] in [0, 1] to non-negative heatmaps [B, N, H/4, W/4]."""
        batch, _, height, width = frame.shape
        x, y = axes(height, width, frame)
        grid = torch.stack([x.expand(height, width), y[:, None].expand(height, width)])  # [2, H, W]
        features = torch.cat([frame - 0.5, grid.expand(batch, 2, height, width)], 1)
        for conv in self.conv:
            features = F.leaky_relu(conv(features), 0.2)
        return F.softplus(self.output(features))

    def forward(self, frame: Tensor) -> Tensor:
        """Keypoints `(x, y, strength)` [B, N, 3] of frame [B, 3, H, W]."""
        heatmaps = self.heatmaps(frame)
        x, y = axes(*heatmaps.shape[-2:], heatmaps)
        weights = heatmaps + 1e-6
        columns, rows = weights.sum(-2), weights.sum(-1)  # [B, N, w], [B, N, h]
        x = (columns / columns.sum(-1, keepdim=True) * x).sum(-1)
        y = (rows / rows.sum(-1, keepdim=True) * y).sum(-1)
        strength = heatmaps.mean((-2, -1))
        strength = strength / (1e-6 + strength.amax(-1, keepdim=True))
        return torch.stack([x, y, strength], -1)

    def maps(self, keypoints: Tensor) -> Tensor:
        """One Gaussian per keypoint, as high as it is strong: [B, N, 3] to [B, N, h, h]."""
        side = self.image_size // 4
        grid_x, grid_y = axes(side, side, keypoints)
        x, y, strength = keypoints[..., None, None].unbind(2)  # [B, N, 1, 1]
        squared = (grid_x - x).square() + (grid_y[:, None] - y).square()
        return (-squared / (2 * STD**2)).exp() * strength

    def gamma(self, keypoints: Tensor) -> Tensor:
        """The keypoint map in [0, 1] at the size of the frame: [B, N, 3] to [B, 1, H, W]."""
        total = self.maps(keypoints).sum(1, keepdim=True)
        form = self.config.gamma
        gamma = (form.steepness * (total - 0.5) if form.kind == "centred" else total).sigmoid()
        size = (self.image_size, self.image_size)
        return F.interpolate(gamma, size=size, mode="bicubic", align_corners=False).clamp(0, 1)
