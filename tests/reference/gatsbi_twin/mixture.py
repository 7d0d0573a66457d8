"""Mixture module: agent and background as K slots, each a mask and a component image."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .components import CompLatents, CompPath, comp_decoder
from .config import GatsbiConfig
from .encoder import FrameEncoder
from .layers import LearnedState, LstmBank, Normal, over_slots
from .masks import MaskDecoder, MaskLatents, MaskPath
from .noise import Noise

Memory = tuple[Tensor, Tensor]
"""Hidden and cell state, [B, K, h] each."""

FAMILIES = ("mask_post", "mask_prior", "comp_post", "comp_prior")
SHARED = {"mask_post": "mask_prior", "comp_post": "comp_prior"}
"""Whose memory the posterior's is, where there is but one."""


@dataclass
class MixtureState:
    """What the module remembers between steps."""

    z_mask: Tensor
    """[B, K, z_mask]."""
    z_comp: Tensor
    """[B, K, z_comp]."""
    memory: dict[str, Memory]
    """By family."""


@dataclass
class MixtureStep:
    """What a step of the module gives besides the state."""

    masks: MaskLatents
    comps: CompLatents
    log_masks: Tensor
    """[B, K, 1, H, W]; the masks sum to one over slots."""
    components: Tensor
    """[B, K, 3, H, W] in [0, 1]."""
    mu_mix: Tensor
    """[B, 3, H, W], the masks' blend of the components."""
    mask_prior: Normal | None = None
    """Prior of the raw mask latents, where asked for while observing."""
    comp_prior: Normal | None = None
    """Prior of the raw component latents, likewise."""


class MemoryFamily(LstmBank):
    """One family of temporal LSTMs with its learned start."""

    def __init__(self, slots: int, inputs: int, hidden: int) -> None:
        super().__init__(slots, inputs, hidden)
        self.start = LearnedState(slots, hidden)


class Mixture(nn.Module):
    """All networks of the module."""

    def __init__(self, config: GatsbiConfig) -> None:
        super().__init__()
        mixture, action, size = config.mixture, config.action.enhanced, config.image_size
        slots = mixture.slots
        self.encoder = FrameEncoder(mixture.encoder, size)
        self.mask = MaskPath(mixture, action)
        self.mask_decoder = MaskDecoder(mixture, action, size)
        self.comp = CompPath(mixture, action, size)
        self.comp_decoder = comp_decoder(mixture, action, size)
        widths = (mixture.z_mask, mixture.z_mask, mixture.z_comp, mixture.z_comp)
        self.memory = nn.ModuleDict(
            {
                family: MemoryFamily(slots, width + mixture.encoder.features, mixture.hidden)
                for family, width in zip(FAMILIES, widths, strict=True)
                if not (mixture.one_memory and family in SHARED)
            }
        )
        self.z_mask_start = nn.Parameter(torch.empty(slots, mixture.z_mask))
        self.z_comp_start = nn.Parameter(torch.empty(slots, mixture.z_comp))

    def initial_state(self, batch: int) -> MixtureState:
        """The learned state before any frame."""
        return MixtureState(
            self.z_mask_start.expand(batch, -1, -1),
            self.z_comp_start.expand(batch, -1, -1),
            self._whole({family: bank.start.expand(batch) for family, bank in self.memory.items()}),
        )

    def observe(
        self, state: MixtureState, frame: Tensor, action: Tensor, first: Tensor, noise: Noise, priors: bool
    ) -> tuple[MixtureState, MixtureStep]:
        """Absorbs frame [B, 3, H, W] under the enhanced action [B, a]; first [B] marks rows without a past."""
        memory = {family: h for family, (h, _) in state.memory.items()}
        masks = self.mask.posterior(
            self.encoder(frame), memory["mask_post"], state.z_mask, action, first, noise["mask"]
        )
        log_masks = self.mask_decoder(masks.z, action)
        comps = self.comp.posterior(
            frame, log_masks, memory["comp_post"], state.z_comp, action, first, noise["component"]
        )
        step = self._decode(masks, comps, log_masks, action)
        if priors:
            step.mask_prior = self.mask.prior_of(masks.z, memory["mask_prior"], state.z_mask, action)
            step.comp_prior = self.comp.prior_of(masks.z, memory["comp_prior"], state.z_comp, action)
        return self._remember(state, step, FAMILIES), step

    def imagine(
        self, state: MixtureState, action: Tensor, first: Tensor, noise: Noise, remember_post: bool = False
    ) -> tuple[MixtureState, MixtureStep]:
        """Predicts a frame from the prior.

        Only the prior's memories move, unless `remember_post`: then the posterior's are fed the same latents.
        """
        memory = {family: h for family, (h, _) in state.memory.items()}
        masks = self.mask.imagine(memory["mask_prior"], state.z_mask, action, first, noise["mask"])
        log_masks = self.mask_decoder(masks.z, action)
        comps = self.comp.imagine(
            masks.z, memory["comp_prior"], state.z_comp, action, first, noise["component"]
        )
        step = self._decode(masks, comps, log_masks, action)
        families = FAMILIES if remember_post else ("mask_prior", "comp_prior")
        return self._remember(state, step, families), step

    def _decode(
        self, masks: MaskLatents, comps: CompLatents, log_masks: Tensor, action: Tensor
    ) -> MixtureStep:
        actions = action.unsqueeze(1).expand(-1, comps.z.shape[1], -1)
        conditioned = self.comp_decoder.condition(torch.cat([comps.z, actions], -1))
        components = over_slots(self.comp_decoder, conditioned)
        mu_mix = (log_masks.exp() * components).sum(1)
        return MixtureStep(masks, comps, log_masks, components, mu_mix)

    def _remember(self, state: MixtureState, step: MixtureStep, families: tuple[str, ...]) -> MixtureState:
        slots = step.components.shape[1]
        encoding = self.encoder(step.mu_mix).unsqueeze(1).expand(-1, slots, -1)  # [B, K, e]
        memory = dict(state.memory)
        for family in (family for family in families if family in self.memory):
            z = step.masks.z if family.startswith("mask") else step.comps.z
            memory[family] = self.memory[family](torch.cat([z, encoding], -1), state.memory[family])
        return MixtureState(step.masks.z, step.comps.z, self._whole(memory))

    def _whole(self, memory: dict[str, Memory]) -> dict[str, Memory]:
        shared = {post: memory[prior] for post, prior in SHARED.items() if post not in self.memory}
        return memory | shared
