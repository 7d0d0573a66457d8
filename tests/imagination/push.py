"""Push: bring an object to a place on the table 8 to 14 cm away.

The policy sees where the hand is, which a robot knows, and where the service believes the object to be, both from the
object towards the goal; the ways that it chooses are turned likewise. So all directions are one task to it.
"""

from __future__ import annotations

from typing import Mapping, Sequence

import gymnasium
import numpy as np
from gatsbi_client import Client
from gatsbi_sim import Observation, Simulator

import goals
from robot import Beginning, Robots, begin

Array = np.ndarray
UNREADY_WEIGHT = 0.5
"""What a metre of the hand's way to behind the object counts beside one of the object's."""


class Push:
    """Minus the object's distance to the goal and, less, what the hand lacks of being behind it; decimetres."""

    steps = 14
    outputs = ("objects",)
    space = gymnasium.spaces.Box(-10, 10, (7,), dtype=np.float32)
    unit = "metres"

    def __init__(self, scene: Simulator, beginnings: Sequence[Beginning] = ()) -> None:
        scene.reset(0)
        self._table, self._beginnings = goals.Table(scene), beginnings

    def begin(self, outputs: Mapping[str, Array], starts: Sequence[int], rng: np.random.Generator) -> None:
        self.robots = Robots([self._beginnings[each] for each in starts])
        here = (outputs["object_ids"] >= 0) & (outputs["objects"][..., 0] >= 0.5)
        # Where a first imagined step has lost all objects, any will do.
        here |= ~here.any(axis=1, keepdims=True)
        places = self._table.metres(outputs["objects"][..., 1:3])
        drawn = [goals.pick(places[row, here[row]], rng) for row in range(len(starts))]
        named = [np.flatnonzero(here[row])[which] for row, (which, _, _) in enumerate(drawn)]
        rows = np.arange(len(starts))
        self._ids = outputs["object_ids"][rows, named]
        self._at = outputs["objects"][rows, named, 1:3].astype(float)
        self.goals = np.array([goal for _, goal, _ in drawn])

    def act(self, actions: Array) -> Array:
        along, across = self._frame()
        actions = actions.clip(-1, 1)
        return self.robots.act(actions[:, :1] * along + actions[:, 1:] * across)

    def observe(self, outputs: Mapping[str, Array]) -> Array:
        self._follow(outputs)
        along, across = self._frame()
        hand = self.robots.hands - self._table.metres(self._at)
        sides = np.stack([(hand * along).sum(axis=1), (hand * across).sum(axis=1)], axis=1)
        far = np.linalg.norm(sides, axis=1, keepdims=True)
        left = np.linalg.norm(self.goals - self._table.metres(self._at), axis=1, keepdims=True)
        seen = [10 * sides, 10 * (far - goals.AROUND), sides / np.maximum(far, 1e-6), 10 * left, np.abs(10 * sides[:, 1:])]
        return np.concatenate(seen, axis=1).clip(-10, 10).astype(np.float32)

    def reward(self, outputs: Mapping[str, Array], actions: Array) -> Array:
        self._follow(outputs)
        place = self._table.metres(self._at)
        left = np.linalg.norm(self.goals - place, axis=1)
        return -10 * (left + UNREADY_WEIGHT * goals.unready(self.robots.hands, place, self.goals))

    def _frame(self) -> tuple[Array, Array]:
        """Unit vectors `[rows, 2]` from the object to the goal, and to the left of that."""
        way = self.goals - self._table.metres(self._at)
        along = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-6)
        return along, np.stack([-along[:, 1], along[:, 0]], axis=1)

    def _follow(self, outputs: Mapping[str, Array]) -> None:
        """Finds the named objects again, by id or, where that is lost, by place."""
        for row, (ids, table) in enumerate(zip(outputs["object_ids"], outputs["objects"])):
            here = np.flatnonzero((ids >= 0) & (table[:, 0] >= 0.5))
            found = here[ids[here] == self._ids[row]]
            if len(found) == 0 and len(here):
                distances = np.linalg.norm(table[here, 1:3] - self._at[row], axis=1)
                found = here[[distances.argmin()]] if distances.min() < goals.LOST else found
            if len(found):
                self._ids[row], self._at[row] = ids[found[0]], table[found[0], 1:3]

    @staticmethod
    def truth(now: Observation) -> dict[str, Array]:
        """What the service would say if it knew the truth."""
        places = goals.in_image([each["pixel"] for each in now.state["objects"]])
        table = np.concatenate([np.ones((len(places), 1)), places, np.zeros((len(places), 3))], axis=1)
        return {"object_ids": np.arange(len(places))[None], "objects": table[None]}

    def draw(self, scene: Simulator, client: Client | None, seed: int) -> tuple[Array, Array]:
        """The goal of an episode in the simulator: where its object is in the picture, and the place to bring it to."""
        now, _ = begin(scene, None, seed)
        at = self.truth(now)["objects"][0, :, 1:3]
        which, goal, _ = goals.pick(self._table.metres(at), np.random.default_rng([7, seed]))
        return at[which], goal

    def pursue(self, goal: tuple[Array, Array], beginning: Beginning, outputs: Mapping[str, Array]) -> None:
        """As `begin`, of one row, in the simulator; the object is told by its place, as a click would."""
        self.robots, self.goals = Robots([beginning]), goal[1][None]
        self._ids, self._at = np.array([-1]), goal[0][None].copy()
        self._follow(outputs)

    def left(self, outputs: Mapping[str, Array]) -> float:
        """How far the first row's object is from its goal, metres."""
        self._follow(outputs)
        return float(np.linalg.norm(self.goals[0] - self._table.metres(self._at)[0]))

    def mark(self) -> Array:
        """Where the first row's goal is in the picture."""
        return self._table.picture(self.goals[0])
