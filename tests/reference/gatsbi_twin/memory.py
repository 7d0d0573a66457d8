"""Memory of an object: an LSTM fed with its latents, its relations and its surroundings."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .config import GatsbiConfig
from .relation import Relation
from .surroundings import Surroundings

Memory = tuple[Tensor, Tensor]
"""Hidden and cell state, [B, N, hidden] each."""


class ObjectMemory(nn.Module):
    """One of the two memories, the posterior's or the prior's."""

    def __init__(self, config: GatsbiConfig) -> None:
        super().__init__()
        objects = config.objects
        hidden = objects.hidden
        self.relation = Relation(objects)
        self.input = nn.Linear(objects.z_width + hidden + Surroundings.width(config), hidden)
        self.cell = nn.LSTMCell(hidden, hidden)
        self.h_start = nn.Parameter(torch.empty(1, 1, hidden))
        self.c_start = nn.Parameter(torch.empty(1, 1, hidden))

    def start(self, batch: int, count: int) -> Memory:
        """Memory of objects never seen before."""
        return self.h_start.expand(batch, count, -1), self.c_start.expand(batch, count, -1)

    def forward(self, z: Tensor, state: Memory, ambient: Tensor) -> Memory:
        """The next state after latents z [B, N, Z] in the surroundings `ambient` [B, N, width]."""
        h, c = state
        x = self.input(torch.cat([z, self.relation(z, h), ambient], -1))
        h, c = self.cell(x.flatten(0, 1), (h.flatten(0, 1), c.flatten(0, 1)))
        return h.unflatten(0, z.shape[:2]), c.unflatten(0, z.shape[:2])
