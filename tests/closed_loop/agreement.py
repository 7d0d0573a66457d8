"""How well the service foresees what the simulator does: both judge the same candidates, along the simulator's own plans.

    python agreement.py --goals 5 [--checkpoint FILE]

It tells how alike the two order candidates where some of them move the object: Spearman's rank correlation of their
costs, and how many of its set the service's favourite beats in the simulator's judgement (half of them by chance).
"""

from __future__ import annotations

import argparse
import os
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from gatsbi_client import Client
from gatsbi_sim import Observation, Simulator

import goals
from arms import Model, Truth
from run import DECISIONS, ROOT, Server
from search import Array, Budget


class Compared(Truth):
    """Plans in the simulator and asks the service about the same candidates."""

    def __init__(self, scene: Simulator, budget: Budget, client: Client) -> None:
        super().__init__(scene, budget)
        self._model = Model(scene, budget, client)
        self.pairs: list[tuple[Array, Array]] = []

    def begin(self, seen: Observation, goal: goals.Goal) -> dict[str, object]:
        self._model.begin(seen, goal)
        return super().begin(seen, goal)

    def look(self, seen: Observation, action: list[float]) -> dict[str, object]:
        self._model.look(seen, action)
        return super().look(seen, action)

    def _left(self, actions: Array) -> Array:
        true = super()._left(actions)
        self.pairs.append((true, self._model._left(actions)))
        return true


def ranks(values: Array) -> Array:
    """Places in ascending order."""
    return np.argsort(np.argsort(values, kind="stable"), kind="stable").astype(float)


def summary(pairs: list[tuple[Array, Array]]) -> str:
    """What is common to true and foreseen costs of the same candidates."""
    # Where no candidate touches the object there is nothing to order.
    moving = [(true, foreseen) for true, foreseen in pairs if np.ptp(true) > 0.05]
    if not moving:
        return f"{len(pairs)} sets of candidates, none that moves the object"
    orders = [np.corrcoef(ranks(true), ranks(foreseen))[0, 1] for true, foreseen in moving]
    places = [ranks(true)[foreseen.argmin()] / (len(true) - 1) for true, foreseen in moving]
    low, middle, high = np.percentile(orders, [25, 50, 75])
    return (
        f"{len(moving)} of {len(pairs)} sets of candidates move the object; rank correlation {middle:.2f} "
        f"(quartiles {low:.2f} to {high:.2f}); the service's favourite beats {1 - np.mean(places):.0%} of its set"
    )


def main() -> None:
    """Prints the agreement."""
    parse = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parse.add_argument("--goals", type=int, default=5)
    parse.add_argument("--first", type=int, default=0)
    parse.add_argument("--checkpoint", type=Path, default=ROOT / "models/checkpoints/push1-tiny.safetensors")
    given = parse.parse_args()
    budget = Budget()
    program = os.environ.get("GATSBI_SIM", str(ROOT / "target/debug/gatsbi-sim"))
    with ExitStack() as stack:
        scene = stack.enter_context(Simulator(goals.SCENE, size=goals.SIZE, program=program))
        client = stack.enter_context(Client(stack.enter_context(Server(given.checkpoint)), timeout=600))
        arm = Compared(scene, budget, client)
        for number in range(given.first, given.first + given.goals):
            goal = goals.draw(scene, number)
            seen = scene.reset(goal.seed)
            goal.set(scene, len(seen.state["objects"]))
            arm.begin(seen, goal)
            distance, decisions = goal.distance, 0
            while decisions < DECISIONS and distance > goals.SUCCESS:
                action, _ = arm.decide()
                seen = scene.step(action)
                distance, decisions = seen.state["goal_distance"], decisions + 1
                arm.look(seen, action)
            print(f"after {number + 1 - given.first} goals: {summary(arm.pairs)}", flush=True)


if __name__ == "__main__":
    main()
