"""The whole model: mixture, agent and objects as one step.

Nothing is drawn here: noise is an argument (`noise`). Actions are those of the network, already scaled.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .action import ActionEnhancer
from .config import GatsbiConfig, TrackingConfig
from .detector import Detector
from .mixture import Mixture, MixtureState, MixtureStep
from .noise import Noise
from .objects import ObjectModule, ObjectState, ObjectStep, Scenery
from .rendering import Rendering
from .surroundings import Agent


@dataclass
class GatsbiState:
    """What the model remembers of a batch of sessions."""

    mixture: MixtureState
    objects: ObjectState
    step: Tensor
    """Steps absorbed, [B] int64."""


@dataclass
class GatsbiStep:
    """What a step gives besides the state."""

    mixture: MixtureStep
    objects: ObjectStep | None
    """While observing."""


class Gatsbi(nn.Module):
    """GATSBI with all parameters."""

    def __init__(self, config: GatsbiConfig, agent_slot: int | None) -> None:
        super().__init__()
        self.action = ActionEnhancer(config.action)
        self.mixture = Mixture(config)
        self.detector = None if config.detector is None else Detector(config.detector, config.image_size)
        self.objects = ObjectModule(config)
        self.agent_slot = agent_slot
        self.config = config

    def initial_state(self, batch: int) -> GatsbiState:
        """The state before any frame."""
        objects = self.objects.initial_state(batch)
        return GatsbiState(self.mixture.initial_state(batch), objects, torch.zeros_like(objects.next_id))

    def observe(
        self,
        state: GatsbiState,
        frame: Tensor,
        action: Tensor,
        noise: Noise,
        discover: bool | Tensor = True,
        tracking: TrackingConfig | None = None,
        priors: bool = False,
    ) -> tuple[GatsbiState, GatsbiStep]:
        """Absorbs frame [B, 3, H, W] in [0, 1] and the action [B, A] that led to it.

        `discover` as in `ObjectModule.observe`. `tracking` is the checkpoint's unless given. `priors` asks for
        the priors of the mixture's latents.
        """
        action = self.action(action)
        mixture, step = self.mixture.observe(state.mixture, frame, action, state.step == 0, noise, priors)
        agent = self._agent(state.mixture, mixture, action)
        scenery = Scenery(frame, step.mu_mix, step.mu_mix, agent)
        objects, object_step = self.objects.observe(
            state.objects, scenery, discover, noise, tracking or self.config.tracking
        )
        return GatsbiState(mixture, objects, state.step + 1), GatsbiStep(step, object_step)

    def imagine(
        self,
        state: GatsbiState,
        action: Tensor,
        noise: Noise,
        tracking: TrackingConfig | None = None,
        remember_post: bool = False,
    ) -> tuple[GatsbiState, GatsbiStep]:
        """Predicts a step under action [B, A]; only the prior's memories move unless `remember_post`."""
        action = self.action(action)
        mixture, step = self.mixture.imagine(state.mixture, action, state.step == 0, noise, remember_post)
        agent = self._agent(state.mixture, mixture, action)
        tracking = tracking or self.config.tracking
        objects = self.objects.imagine(state.objects, step.mu_mix, agent, noise, tracking, remember_post)
        return GatsbiState(mixture, objects, state.step + 1), GatsbiStep(step, None)

    def skip(
        self, state: GatsbiState, action: Tensor, noise: Noise, tracking: TrackingConfig | None = None
    ) -> tuple[GatsbiState, GatsbiStep]:
        """Passes over a frame that never came: imagines it and remembers it as if it had been seen."""
        return self.imagine(state, action, noise, tracking, remember_post=True)

    def render(self, state: GatsbiState) -> Rendering:
        """Draws the objects of a state."""
        return self.objects.render(state.objects.z)

    def _agent(self, before: MixtureState, after: MixtureState, action: Tensor) -> Agent | None:
        """The agent slot, cut off from gradients: objects must not re-shape it."""
        if self.agent_slot is None:
            return None
        mixture = after if self.config.objects.agent_history == "after" else before
        history = mixture.memory["mask_prior"][0]
        slot = self.agent_slot
        return Agent(after.z_mask[:, slot].detach(), history[:, slot].detach(), action.detach())
