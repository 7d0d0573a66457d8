"""The arms of the comparison: who decides, and what an arm may look at.

`Nothing` and `Random` look at nothing. `Model` sees frames alone, through the service. `Truth` searches as `Model` does,
with the same code and budget, in the simulator itself. `ServicePlan` leaves the search to the service, over joint
velocities. All know what a robot knows of itself: which actions move its hand how, and where its hand appears.
"""

from __future__ import annotations

import time
from typing import Any, Protocol

import numpy as np
from gatsbi_client import Cem, Client, Icem as ServiceIcem, Session, costs
from gatsbi_sim import Observation, Simulator

from goals import CLICK, LOST, SIZE, Goal, Table, in_image, unready
from search import Array, Budget, Icem

REACH = 0.06
"""Largest displacement of the hand in a step, metres; the data sets' pushes reach 0.068."""
HAND_WEIGHT = 1.0
"""How much it counts, a metre, that the hand is not behind the object yet."""
LAST_WEIGHT = 2.0
"""How much the last step counts beside the mean of all."""


class Arm(Protocol):
    """Decides. What it tells of a decision is kept in the record."""

    def begin(self, seen: Observation, goal: Goal) -> dict[str, Any]:
        """The first frame of an episode."""

    def decide(self) -> tuple[list[float], dict[str, Any]]:
        """The next action."""

    def look(self, seen: Observation, action: list[float]) -> dict[str, Any]:
        """The frame that the action led to."""


class Nothing:
    """Stands still."""

    def begin(self, seen: Observation, goal: Goal) -> dict[str, Any]:
        self._still = [0.0] * len(seen.state["joint_positions"][:7])
        return {}

    def decide(self) -> tuple[list[float], dict[str, Any]]:
        return self._still, {"steps": 0}

    def look(self, seen: Observation, action: list[float]) -> dict[str, Any]:
        return {}


class Random(Nothing):
    """Moves the hand as the search's first candidates do."""

    def __init__(self, scene: Simulator, budget: Budget) -> None:
        self._scene, self._budget = scene, budget

    def begin(self, seen: Observation, goal: Goal) -> dict[str, Any]:
        search = Icem(self._budget, REACH, np.random.default_rng([1, goal.number]))
        ways = [(0.7 * REACH * search.noise(1)[0]).clip(-REACH, REACH) for _ in range(20)]
        self._way = iter(np.concatenate(ways))
        return {}

    def decide(self) -> tuple[list[float], dict[str, Any]]:
        (move,) = self._scene.hand_moves(next(self._way)[None, None])
        return move[0]["action"], {"steps": 0}


class _Searching:
    """What the two searching arms share: everything but where an object is going to be."""

    def __init__(self, scene: Simulator, budget: Budget) -> None:
        self._scene, self._budget = scene, budget

    def begin(self, seen: Observation, goal: Goal) -> dict[str, Any]:
        self._goal, self._target = goal, in_image(goal.pixel)
        self._search = Icem(self._budget, REACH, np.random.default_rng([2, goal.number]))
        self._table = Table(self._scene)
        return {}

    def decide(self) -> tuple[list[float], dict[str, Any]]:
        began = time.monotonic()
        at = self._where()
        place, target = self._table.metres(at), np.array(self._goal.target)
        best: tuple[float, list[float]] = (np.inf, [])

        def cost(displacements: Array) -> Array:
            nonlocal best
            moves = self._scene.hand_moves(displacements)
            actions = [[step["action"] for step in way] for way in moves]
            hands = np.array([[step["position"][:2] for step in way] for way in moves])
            total = self._left(np.array(actions)) + HAND_WEIGHT * unready(hands, place, target).min(axis=1)
            first = int(total.argmin())
            if total[first] < best[0]:
                best = (float(total[first]), actions[first][0])
            return total

        self._search.plan(cost)
        least, action = best
        told = {"steps": self._budget.steps, "seconds": time.monotonic() - began, "cost": least}
        return action, told | {"at": at.tolist()}

    def _where(self) -> Array:
        """Where the object is now, in [-1, 1]."""
        raise NotImplementedError

    def _left(self, actions: Array) -> Array:
        """What is left of the object's way, `[N]`, under `[N, H, A]`: the mean of all steps and, weighted, the last."""
        raise NotImplementedError


class Truth(_Searching):
    """Searches in the simulator: the upper bound."""

    def begin(self, seen: Observation, goal: Goal) -> dict[str, Any]:
        self._seen = seen
        return super().begin(seen, goal)

    def look(self, seen: Observation, action: list[float]) -> dict[str, Any]:
        self._seen = seen
        return {}

    def _where(self) -> Array:
        return in_image(self._seen.state["objects"][self._goal.named]["pixel"])

    def _left(self, actions: Array) -> Array:
        futures = self._scene.futures(actions)
        objects = in_image([[step[self._goal.named]["pixel"] for step in way] for way in futures])
        left = np.linalg.norm(objects - self._target, axis=-1)
        return left.mean(axis=1) + LAST_WEIGHT * left[:, -1]


class Model(_Searching):
    """Searches in the service's imagination, from frames alone.

    Which of the objects it sees is the named one is told once, by a click at its centre in the first frame.
    """

    def __init__(self, scene: Simulator, budget: Budget, client: Client) -> None:
        super().__init__(scene, budget)
        self._client = client
        self._session: Session | None = None

    def begin(self, seen: Observation, goal: Goal) -> dict[str, Any]:
        super().begin(seen, goal)
        if self._session is not None:
            self._session.delete()
        self._session = self._client.create_session()
        self._at = in_image(seen.state["objects"][goal.named]["pixel"])
        self._id: int | None = None
        self._met = False
        return self.look(seen, None)

    def look(self, seen: Observation, action: list[float] | None) -> dict[str, Any]:
        assert self._session is not None
        self._belief = self._session.observe(np.asarray(seen.rgb).reshape(SIZE, SIZE, 3), action)
        present = {each.id: np.array([each.x, each.y]) for each in self._belief.present()}
        found = self._id in present
        if not found and present:
            near = min(present, key=lambda each: float(np.linalg.norm(present[each] - self._at)))
            if np.linalg.norm(present[near] - self._at) < (LOST if self._met else CLICK):
                self._id, self._met, found = near, True, True
        if all(each.id != self._id for each in self._belief.objects):
            self._id = None
        if found and self._id is not None:
            self._at = present[self._id]
        truth = in_image(seen.state["objects"][self._goal.named]["pixel"])
        return {"found": found, "id": self._id, "off": float(np.linalg.norm(self._at - truth))}

    def _where(self) -> Array:
        return self._at

    def _left(self, actions: Array) -> Array:
        if self._id is None:
            return np.zeros(len(actions))
        assert self._session is not None
        return self._session.score(actions, costs.program(*self._terms(self._id))).costs

    def _terms(self, named: int) -> list[costs.CostTerm]:
        x, y = (float(value) for value in self._target)
        last = costs.to_target(named, x, y, when="last_step", weight=LAST_WEIGHT)
        return [costs.to_target(named, x, y), last]


class ServicePlan(Model):
    """Leaves the search to the service: iCEM over seven joint velocities, next to the model."""

    def decide(self) -> tuple[list[float], dict[str, Any]]:
        assert self._session is not None
        began, budget = time.monotonic(), self._budget
        if self._id is None:
            return [0.0] * 7, {"steps": 0}
        # There is no term for being behind it; near it is the best that can be said.
        reaching = costs.between("agent", self._id, weight=0.25)
        program = costs.program(*self._terms(self._id), reaching)
        cem = Cem(candidates=budget.candidates, iterations=budget.iterations, elites=Icem.elites)
        plan = self._session.plan(
            budget.horizon, program, optimiser=ServiceIcem(cem=cem, decay=1.0), warm_start=True,
            seed=self._goal.number, action_min=[-1.0] * 7, action_max=[1.0] * 7,
        )
        told = {"seconds": time.monotonic() - began, "cost": plan.cost}
        return plan.actions[0].tolist(), told | {"steps": plan.candidates * budget.horizon}
