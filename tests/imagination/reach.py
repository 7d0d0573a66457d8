"""Reach: bring the arm to where it is in another picture.

The arm's place is the centre of its mask, which is all that the policy sees beside its goal.
"""

from __future__ import annotations

from typing import Mapping, Sequence

import gymnasium
import numpy as np
from gatsbi_client import Client
from gatsbi_client.gym import mask_centres
from gatsbi_sim import Observation, Simulator

from robot import Beginning, Robots, begin

Array = np.ndarray
GOAL_SEEDS = 10_000
"""In the simulator, an episode's goal is where the arm is at the beginning of the episode this far away."""


class Reach:
    """Minus the distance of the arm's place to the goal, each step; half the picture's side is 1."""

    steps = 8
    outputs = ("agent_mask",)
    space = gymnasium.spaces.Box(-4, 4, (4,), dtype=np.float32)
    unit = "pixels"

    def __init__(self, scene: Simulator, beginnings: Sequence[Beginning] = ()) -> None:
        """In imagination goals are drawn from where the arm is at the beginnings."""
        self._beginnings = beginnings
        self._places = np.array([mask_centres(each.outputs["agent_mask"])[0] for each in beginnings])

    def begin(self, outputs: Mapping[str, Array], starts: Sequence[int], rng: np.random.Generator) -> None:
        self.robots = Robots([self._beginnings[each] for each in starts])
        self.goals = self._places[rng.integers(len(self._places), size=len(starts))]

    def act(self, actions: Array) -> Array:
        return self.robots.act(actions.clip(-1, 1))

    def observe(self, outputs: Mapping[str, Array]) -> Array:
        places = mask_centres(outputs["agent_mask"])
        return np.concatenate([2 * places, 2 * (self.goals - places)], axis=1).astype(np.float32)

    def reward(self, outputs: Mapping[str, Array], actions: Array) -> Array:
        return -np.linalg.norm(self.goals - mask_centres(outputs["agent_mask"]), axis=1)

    @staticmethod
    def truth(now: Observation) -> dict[str, Array]:
        """What the service would say if it knew the truth."""
        return {"agent_mask": (np.array(now.mask) == 1)[None].astype(np.float32)}

    def draw(self, scene: Simulator, client: Client | None, seed: int) -> Array:
        """The goal `[1, 2]` of an episode in the simulator, as the service sees it or, without a client, as it is."""
        shown, beginning = begin(scene, client, seed + GOAL_SEEDS, self.outputs)
        if beginning.session is not None:
            beginning.session.delete()
        return mask_centres((beginning.outputs or self.truth(shown))["agent_mask"])

    def pursue(self, goal: Array, beginning: Beginning, outputs: Mapping[str, Array]) -> None:
        """As `begin`, of one row, in the simulator."""
        self.robots, self.goals = Robots([beginning]), goal

    def left(self, outputs: Mapping[str, Array]) -> float:
        """How far the first row is from its goal, pixels."""
        return float(-self.reward(outputs, np.zeros(0))[0]) * outputs["agent_mask"].shape[-1] / 2

    def mark(self) -> Array:
        """Where the first row's goal is in the picture."""
        return self.goals[0]
