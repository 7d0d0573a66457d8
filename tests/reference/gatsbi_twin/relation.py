"""What the other objects do to an object: pair networks over a fully connected or nearest-neighbour graph."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .config import GraphConfig, ObjectConfig
from .latents import ObjectLatents
from .layers import Mlp

SHIFT = slice(4, 6)
"""Columns of the centre in a latent vector."""


class Relation(nn.Module):
    """Pair networks of one memory, and the object's effect on itself."""

    def __init__(self, config: ObjectConfig) -> None:
        super().__init__()
        features, hidden = config.z_width + config.hidden, config.hidden
        self.own = Mlp([features, hidden, hidden, hidden])
        self.relational = Mlp([2 * features, hidden, hidden, hidden])
        self.weights = Mlp([2 * features, hidden, hidden, 1])
        self.config = config

    def forward(self, z: Tensor, h: Tensor) -> Tensor:
        """z [B, N, Z], h [B, N, hidden] to interactions [B, N, hidden]."""
        u = torch.cat([z, h], -1)  # [B, N, U]
        latents = ObjectLatents.split(z, self.config)
        shift, presence = latents.where[..., 2:], latents.pres
        graph = self.config.graph
        if graph.kind == "fully_connected":
            effect = self._everyone(u, shift, presence)
        else:
            effect = self._neighbours(u, shift, presence, graph)
        return self.own(u) + effect

    def _everyone(self, u: Tensor, shift: Tensor, presence: Tensor) -> Tensor:
        pairs = all_pairs(u, shift)
        attention = self.weights(pairs).softmax(2) * presence.unsqueeze(1)  # [B, N, N, 1]
        others = 1 - torch.eye(u.shape[1], dtype=u.dtype, device=u.device).unsqueeze(-1)
        return weighted_sum(attention * others, self.relational(pairs))

    def _neighbours(self, u: Tensor, shift: Tensor, presence: Tensor, graph: GraphConfig) -> Tensor:
        count = min(graph.k, u.shape[1] - 1)
        if graph.metric == "distance":
            chosen = nearest(shift, presence, count)
        else:
            chosen = heaviest(self.weights(all_pairs(u, shift)), presence, count)
        batch = torch.arange(u.shape[0], device=u.device)[:, None, None]
        presence = presence[batch, chosen]  # [B, N, k, 1]
        pairs = pair_vectors(u.unsqueeze(2), u[batch, chosen], shift.unsqueeze(2), shift[batch, chosen])
        effects = self.relational(pairs)  # [B, N, k, hidden]
        if graph.aggregate == "sum":
            return (presence * effects).sum(2)
        return weighted_sum(self.weights(pairs).softmax(2) * presence, effects)


def pair_vectors(u_i: Tensor, u_j: Tensor, shift_i: Tensor, shift_j: Tensor) -> Tensor:
    """`[u_i, u_j]` with the sender's centre replaced by its offset from the receiver, [B, N, M, 2 U]."""
    offset = shift_i - shift_j
    shape = offset.shape[:-1]
    before, after = u_j[..., : SHIFT.start], u_j[..., SHIFT.stop :]
    parts = (u_i, before, offset, after)
    return torch.cat([part.expand(*shape, -1) for part in parts], -1)


def all_pairs(u: Tensor, shift: Tensor) -> Tensor:
    """Pair vectors of all receivers i and senders j, [B, N, N, 2 U]."""
    return pair_vectors(u.unsqueeze(2), u.unsqueeze(1), shift.unsqueeze(2), shift.unsqueeze(1))


def weighted_sum(weights: Tensor, effects: Tensor) -> Tensor:
    """Effects [B, N, M, hidden] summed under weights [B, N, M, 1] that are first normalised over M."""
    return (weights / (weights.sum(2, keepdim=True) + 1e-4) * effects).sum(2)


def nearest(shift: Tensor, presence: Tensor, count: int) -> Tensor:
    """Indices [B, N, count] of the other objects by distance; absent ones come last, ties go to the lower index."""
    with torch.no_grad():
        distance = (shift.unsqueeze(2) - shift.unsqueeze(1)).square().sum(-1)  # [B, N, N]
        distance.diagonal(dim1=1, dim2=2).fill_(torch.inf)
        absent = (presence.squeeze(-1) < 0.5).unsqueeze(1).expand_as(distance)
        by_distance = distance.argsort(dim=-1, stable=True)
        absent = absent.gather(-1, by_distance) | distance.gather(-1, by_distance).isinf()
        # Objects themselves are at infinity and count as absent, so they stay at the very end.
        return by_distance.gather(-1, absent.int().argsort(dim=-1, stable=True))[..., :count]


def heaviest(logits: Tensor, presence: Tensor, count: int) -> Tensor:
    """Indices [B, N, count] of the other objects by attention times presence; ties go to the lower index."""
    with torch.no_grad():
        weight = (logits.softmax(2) * presence.unsqueeze(1)).squeeze(-1)  # [B, N, N]
        weight.diagonal(dim1=1, dim2=2).fill_(-1)
        return weight.argsort(dim=-1, descending=True, stable=True)[..., :count]
