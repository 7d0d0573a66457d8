"""Object module: propagation, discovery, selection, memories and rendering."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from . import handover
from .config import GatsbiConfig, TrackingConfig
from .discovery import Discovered, Discovery
from .glimpses import GlimpseDecoder
from .latents import ObjectLatents, presence_kl
from .layers import Normal
from .memory import Memory, ObjectMemory
from .noise import Noise
from .propagation import Propagated, Propagation
from .rendering import Rendering, render
from .spatial import intersection_over_union, paste
from .surroundings import Agent, Surroundings


@dataclass
class ObjectState:
    """What the module remembers between steps."""

    z: Tensor
    """Latent vectors, [B, MAX, Z]."""
    post: Memory
    prior: Memory
    ids: Tensor
    """[B, MAX] int64, -1 in slots never filled."""
    next_id: Tensor
    """[B] int64."""


@dataclass
class Scenery:
    """What objects are looked for in."""

    frame: Tensor
    """[B, 3, H, W] in [0, 1]."""
    difference_from: Tensor
    """`mu_mix` for the difference that discovery sees."""
    background: Tensor
    """`mu_mix` for the environment crops."""
    agent: Agent | None


@dataclass
class ObjectStep:
    """What an observed step gives besides the state."""

    proposal: Tensor
    """Window each kept object was looked for in, [B, MAX, 4]; a new object's own box."""
    kl: dict[str, Tensor]
    """KL terms by quantity, [B] each."""


class ObjectModule(nn.Module):
    """All networks of the module."""

    def __init__(self, config: GatsbiConfig) -> None:
        super().__init__()
        self.propagation = Propagation(config.objects)
        self.discovery = Discovery(config.objects, config.image_size)
        self.surroundings = Surroundings(config)
        self.post = ObjectMemory(config)
        self.prior = ObjectMemory(config)
        self.decoder = GlimpseDecoder(config.objects)
        self.config = config.objects
        self.image_size = config.image_size

    def initial_state(self, batch: int) -> ObjectState:
        """No objects."""
        count, like = self.config.max_objects, self.post.h_start
        z = torch.zeros(batch, count, self.config.z_width, dtype=like.dtype, device=like.device)
        ids = torch.full((batch, count), -1, device=like.device)
        next_id = torch.zeros(batch, dtype=torch.int64, device=like.device)
        return ObjectState(z, self.post.start(batch, count), self.prior.start(batch, count), ids, next_id)

    def observe(
        self,
        state: ObjectState,
        scenery: Scenery,
        discover: bool | Tensor,
        noise: Noise,
        tracking: TrackingConfig,
    ) -> tuple[ObjectState, ObjectStep]:
        """Tracks known objects into a frame and looks for new ones.

        `discover` says for all rows together, or for each in a [B] bool tensor, whether to look for new ones.
        """
        post, prior = state.post, state.prior
        late = self.config.agent_feature == "next"
        if late:
            post, prior = self._remember(state.z, post, prior, scenery.background, scenery.agent)
        propagated = self.propagation.observe(state.z, post[0], prior[0], scenery.frame, noise, tracking)
        z = propagated.latents.join()
        if not late:
            post, prior = self._remember(z, post, prior, scenery.background, scenery.agent)
        if tracking.handover is not None:
            z = torch.where(state.z[..., :1] > 0.5, z, state.z)
        proposal = propagated.proposal
        kl = self._kl_known(propagated, state.ids >= 0)
        found = None
        if discover is not False:
            found, z, cells = self._discover(state, z, scenery, noise, tracking)
        candidates = ObjectState(z, post, prior, state.ids, state.next_id)
        order = z[..., 0]
        if found is not None:
            new = self._new(cells, state.next_id, scenery)
            rows = torch.full_like(state.next_id, True, dtype=torch.bool) if discover is True else discover
            new_order = torch.where(rows[:, None], new.z[..., 0], -1)
            if tracking.handover is not None:
                new_order = torch.where(new_order > 0.5, new_order, -1)
            for name, term in self._kl_new(found).items():
                kl[name] = kl[name] + term * rows
            order = torch.cat([new_order, order], 1)
            proposal = torch.cat([found.latents.where, proposal], 1)
            candidates = _concatenate(new, candidates)
        kept = order.argsort(dim=1, descending=True, stable=True)[:, : self.config.max_objects]
        is_new = kept < order.shape[1] - self.config.max_objects
        state = _number(_gather(candidates, kept), is_new, tracking)
        if tracking.merge is not None:
            unlike = None
            if tracking.unlike is not None:
                unlike = handover.different(self._colours(state.z), tracking.unlike)
            _merge(state, tracking.merge, unlike)
        return state, ObjectStep(_gather_rows(proposal, kept), kl)

    def imagine(
        self,
        state: ObjectState,
        background: Tensor,
        agent: Agent | None,
        noise: Noise,
        tracking: TrackingConfig,
        remember_post: bool = False,
    ) -> ObjectState:
        """Carries objects on without a frame.

        Only the prior's memory moves, unless `remember_post`: then the posterior's is fed the same latents.
        """
        late = self.config.agent_feature == "next"
        z, prior = state.z, state.prior
        if not late:
            z = self.propagation.imagine(z, prior[0], noise, tracking)
        environment = self.surroundings.environment(z, background)
        prior = self._move(self.prior, z, prior, environment, agent)
        post = self._move(self.post, z, state.post, environment, agent) if remember_post else state.post
        if late:
            z = self.propagation.imagine(z, prior[0], noise, tracking)
        return ObjectState(z, post, prior, state.ids, state.next_id)

    def render(self, z: Tensor) -> Rendering:
        """Draws objects z [B, N, Z]."""
        return render(self.decoder, z, self.config, self.image_size)

    def _discover(
        self, state: ObjectState, z: Tensor, scenery: Scenery, noise: Noise, tracking: TrackingConfig
    ) -> tuple[Discovered, Tensor, Tensor]:
        """What is found, and latent vectors of the known objects and of the finds after identities have been handed over."""
        frame, mu_mix = scenery.frame, scenery.difference_from
        known, alike, visible = None, None, z
        if tracking.unlike is not None:
            known = handover.Known(z, state.z, state.ids, self._colours(state.z), frame, tracking.unlike)
            alike = known.same_colour
        if known is not None and tracking.handover is not None:
            visible = known.visible()
            _, alpha = self.decoder(ObjectLatents.split(state.z, self.config).what)
            drawn = paste(alpha * visible[..., :1, None, None], visible[..., 2:6], self.image_size)
            frame = torch.lerp(frame, mu_mix, drawn.amax(1))
        found = self.discovery(frame, frame - mu_mix, ObjectLatents.split(visible, self.config), noise, alike)
        cells = found.latents.join()
        if known is not None and tracking.handover is not None:
            cells = handover.without(cells, known.bare(cells, mu_mix))
            z, cells = known.reunited(cells, visible, tracking.handover)
        return found, z, cells

    def _colours(self, z: Tensor) -> Tensor:
        """Mean colours of objects z [B, N, Z], [B, N, 3]."""
        return handover.drawn(*self.decoder(ObjectLatents.split(z, self.config).what))

    def _new(self, z: Tensor, next_id: Tensor, scenery: Scenery) -> ObjectState:
        """Candidates z [B, G * G, Z] with memories and identities."""
        batch, cells, _ = z.shape
        start = (self.post.start(batch, cells), self.prior.start(batch, cells))
        if self.config.agent_feature == "next":
            post, prior = start
        else:
            post, prior = self._remember(z, *start, scenery.background, scenery.agent)
        ids = next_id[:, None] + torch.arange(cells, device=z.device)
        return ObjectState(z, post, prior, ids, next_id)

    def _remember(
        self, z: Tensor, post: Memory, prior: Memory, background: Tensor, agent: Agent | None
    ) -> tuple[Memory, Memory]:
        environment = self.surroundings.environment(z, background)
        return (
            self._move(self.post, z, post, environment, agent),
            self._move(self.prior, z, prior, environment, agent),
        )

    def _move(
        self, memory: ObjectMemory, z: Tensor, state: Memory, environment: Tensor, agent: Agent | None
    ) -> Memory:
        return memory(z, state, self.surroundings(environment, z, state[0], agent))

    def _kl_known(self, propagated: Propagated, filled: Tensor) -> dict[str, Tensor]:
        """Terms of the propagated objects; slots never filled, filled [B, N] false, do not count."""
        zero = torch.zeros_like(filled[:, 0], dtype=propagated.proposal.dtype)
        terms = dict.fromkeys(("pres", "depth", "where", "what"), zero)
        terms["dyna"] = _sum(propagated.dyna.kl(propagated.dyna_prior) * filled.unsqueeze(-1))
        if self.config.aux_presence_kl:
            kl = presence_kl(propagated.attributes.presence, self.config.prior.presence)
            terms["pres"] = _sum(kl * filled.unsqueeze(-1))
        return terms

    def _kl_new(self, found: Discovered) -> dict[str, Tensor]:
        """Terms of all cells. Where, what and depth count as far as an object was sampled before rejection."""
        prior, weight = self.config.prior, found.sampled_presence
        means = weight.new_tensor([prior.scale_mean] * 2 + [prior.shift_mean] * 2)
        stds = weight.new_tensor([prior.scale_std] * 2 + [prior.shift_std] * 2)
        standard = Normal(weight.new_zeros(()), weight.new_ones(()))
        return {
            "pres": _sum(presence_kl(found.presence, prior.presence)),
            "depth": _sum(found.depth.kl(standard) * weight),
            "where": _sum(found.raw_where.kl(Normal(means, stds)) * weight),
            "what": _sum(found.what.kl(standard) * weight),
            "dyna": _sum(found.dyna.kl(standard)),
        }


def _sum(x: Tensor) -> Tensor:
    """Over everything but the batch, [B]."""
    return x.flatten(1).sum(1)


def _number(state: ObjectState, is_new: Tensor, tracking: TrackingConfig) -> ObjectState:
    """The kept objects with final identities; is_new [B, MAX] marks those just discovered.

    The original rule keeps the candidates' numbers, counts on from the largest one kept, and so can give a
    number twice. The monotone rule numbers new objects slot by slot from a counter that never goes back.
    """
    if tracking.ids == "original":
        state.next_id = 1 + state.ids.amax(1)
        return state
    counted = state.next_id[:, None] + is_new.cumsum(1)
    state.ids = torch.where(is_new, counted - 1, state.ids)
    state.next_id = counted[:, -1]
    return state


def _merge(state: ObjectState, threshold: float, unlike: Tensor | None) -> None:
    """Takes the presence from boxes that overlap a present one of a lower number by more than the threshold.

    Pairs that are unlike [B, MAX, MAX] stay.
    """
    presence, boxes = state.z[..., 0], state.z[..., 2:6].detach()
    close = intersection_over_union(boxes, boxes) > threshold
    if unlike is not None:
        close &= ~unlike
    older = state.ids[:, None, :] < state.ids[:, :, None]
    same = (close & older & (presence > 0.5)[:, None, :]).any(-1)
    state.z = torch.cat([torch.where(same, 0, presence).unsqueeze(-1), state.z[..., 1:]], -1)


def _gather_rows(x: Tensor, kept: Tensor) -> Tensor:
    """Entries kept [B, MAX] of x [B, N, ...]."""
    return x[torch.arange(x.shape[0], device=x.device)[:, None], kept]


def _gather(state: ObjectState, kept: Tensor) -> ObjectState:
    h_post, c_post, h_prior, c_prior = (_gather_rows(x, kept) for x in (*state.post, *state.prior))
    z, ids = _gather_rows(state.z, kept), _gather_rows(state.ids, kept)
    return ObjectState(z, (h_post, c_post), (h_prior, c_prior), ids, state.next_id)


def _concatenate(a: ObjectState, b: ObjectState) -> ObjectState:
    """Slots of `a`, then those of `b`; `next_id` is that of `b`."""

    def both(x: Tensor, y: Tensor) -> Tensor:
        return torch.cat([x, y], 1)

    post = (both(a.post[0], b.post[0]), both(a.post[1], b.post[1]))
    prior = (both(a.prior[0], b.prior[0]), both(a.prior[1], b.prior[1]))
    return ObjectState(both(a.z, b.z), post, prior, both(a.ids, b.ids), b.next_id)
