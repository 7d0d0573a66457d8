"""Image encoder of discovery: the first stages of a residual network."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from .config import ObjectConfig


class BasicBlock(nn.Module):
    """Two 3x3 convolutions with batch norm around a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample: nn.Module | None = None
        if stride != 1 or inputs != outputs:
            shortcut = nn.Conv2d(inputs, outputs, 1, stride, bias=False)
            self.downsample = nn.Sequential(shortcut, nn.BatchNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """[B, inputs, h, w] to [B, outputs, h / stride, w / stride]."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(x)) + shortcut)


class ImageEncoder(nn.Module):
    """Frame and its difference from the background to features per cell."""

    def __init__(self, config: ObjectConfig, image_size: int) -> None:
        super().__init__()
        channels, blocks = config.image_encoder.channels, config.image_encoder.blocks
        stem = nn.Conv2d(6, channels[0], 7, 2, 3, bias=False)
        layers: list[nn.Module] = [stem, nn.BatchNorm2d(channels[0]), nn.ReLU()]
        inputs = channels[0]
        for stage, outputs in enumerate(channels):
            stack = []
            for block in range(blocks):
                stack.append(BasicBlock(inputs, outputs, 2 if stage > 0 and block == 0 else 1))
                inputs = outputs
            layers.append(nn.Sequential(*stack))
        self.enc = nn.Sequential(*layers)
        stride = image_size // (config.grid << len(channels))
        self.last = nn.Conv2d(inputs, config.hidden, 3, stride, 1)

    def forward(self, x: Tensor) -> Tensor:
        """[B, 6, H, W] to [B, hidden, G, G]."""
        return self.last(self.enc(x))
