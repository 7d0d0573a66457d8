"""Building blocks: MLPs, normal distributions, strided and enlarging convolution stages, LSTM banks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .config import StageConfig

SCALE_FLOOR = 1e-4
SCALE_CEILING = 10.0


class Mlp(nn.Module):
    """Linear layers `layers.{i}` with an activation between them and none at the end."""

    def __init__(self, widths: Sequence[int], activation: type[nn.Module] = nn.CELU) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(inputs, outputs) for inputs, outputs in pairwise(widths))
        self.activation = activation()

    def forward(self, x: Tensor) -> Tensor:
        """[..., widths[0]] to [..., widths[-1]]."""
        *hidden, last = self.layers
        for layer in hidden:
            x = self.activation(layer(x))
        return last(x)


@dataclass
class Normal:
    """Independent normal distributions."""

    mean: Tensor
    std: Tensor

    def draw(self, noise: Tensor) -> Tensor:
        """The sample that standard normal `noise` stands for."""
        return self.mean + self.std * noise

    def kl(self, prior: Normal) -> Tensor:
        """KL(self | prior) per element."""
        ratio = (self.std / prior.std).square()
        distance = ((self.mean - prior.mean) / prior.std).square()
        return 0.5 * (ratio + distance - 1 - ratio.log())


def positive(x: Tensor) -> Tensor:
    """A standard deviation from an unbounded number."""
    return F.softplus(x) + SCALE_FLOOR


def bounded_normal(parameters: Tensor) -> Normal:
    """Distribution of the mixture module from [..., 2 d]: means, then raw scales."""
    mean, scale = parameters.chunk(2, -1)
    return Normal(mean, positive(scale).clamp(max=SCALE_CEILING))


class LstmBank(nn.Module):
    """K LSTM cells side by side, each with weights of its own."""

    def __init__(self, cells: int, inputs: int, hidden: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(cells, inputs + hidden, 4 * hidden))
        self.bias = nn.Parameter(torch.empty(cells, 4 * hidden))

    def forward(self, x: Tensor, state: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """x [B, K, inputs], state h, c [B, K, hidden] each; returns the next h, c."""
        h, c = state
        rows = torch.cat([x, h], -1).transpose(0, 1)  # [K, B, inputs + hidden]
        gates = torch.baddbmm(self.bias.unsqueeze(1), rows, self.weight)  # [K, B, 4 hidden]
        write, keep, new, show = gates.transpose(0, 1).chunk(4, -1)
        c = keep.sigmoid() * c + write.sigmoid() * new.tanh()
        return show.sigmoid() * c.tanh(), c


class LearnedState(nn.Module):
    """A learned initial LSTM state `h`, `c` of the given shape."""

    def __init__(self, *shape: int) -> None:
        super().__init__()
        self.h = nn.Parameter(torch.empty(shape))
        self.c = nn.Parameter(torch.empty(shape))

    def expand(self, batch: int) -> tuple[Tensor, Tensor]:
        """h, c, [batch, *shape] each."""
        return self.h.expand(batch, *self.h.shape), self.c.expand(batch, *self.c.shape)


class EnlargingStage(nn.Module):
    """1x1 convolution and pixel shuffle, then a 3x3 convolution; activation before norm after each."""

    def __init__(self, inputs: int, stage: StageConfig) -> None:
        super().__init__()
        channels = stage.channels
        self.enlarge = nn.Conv2d(inputs, channels * stage.factor**2, 1)
        self.enlarge_norm = nn.GroupNorm(stage.groups, channels)
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)
        self.norm = nn.GroupNorm(stage.groups, channels)
        self.factor = stage.factor

    def forward(self, x: Tensor) -> Tensor:
        """[B, inputs, h, w] to [B, channels, factor h, factor w]."""
        x = self.enlarge_norm(F.celu(F.pixel_shuffle(self.enlarge(x), self.factor)))
        return self.norm(F.celu(self.conv(x)))


def enlarging_stages(inputs: int, stages: list[StageConfig]) -> nn.ModuleList:
    """The stages one after another."""
    widths = [inputs, *(stage.channels for stage in stages)]
    return nn.ModuleList(EnlargingStage(i, stage) for i, stage in zip(widths, stages, strict=False))


def fit(images: Tensor, size: int) -> Tensor:
    """[B, C, h, w] enlarged bilinearly to [B, C, size, size] where smaller."""
    if images.shape[-1] == size:
        return images
    return F.interpolate(images, size=(size, size), mode="bilinear", align_corners=False)


def component_norm(kind: str, channels: int) -> nn.Module:
    """Norm of the component networks: batch norm, or group norm with eight channels a group."""
    if kind == "batch":
        return nn.BatchNorm2d(channels, momentum=0.01)
    return nn.GroupNorm(max(channels // 8, 1), channels)


def over_slots(module: nn.Module, x: Tensor) -> Tensor:
    """Applies a network on [B, ...] to [B, K, ...], all slots as one batch."""
    batch, slots = x.shape[:2]
    return module(x.flatten(0, 1)).unflatten(0, (batch, slots))
