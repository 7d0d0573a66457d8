"""Robots that act in imagination and in the simulator alike, and the beginnings of their episodes.

A policy displaces hands in the plane of the table; the robot's kinematics (`arm.py`) turn that into joint velocities,
which is what the service and the simulator take.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Mapping, Protocol, Sequence

import numpy as np
from gatsbi_client import Belief, Client, Session
from gatsbi_client.gym import Task
from gatsbi_sim import Observation, Simulator

import arm
from arms import REACH
from search import Budget, Icem

Array = np.ndarray

FRAMES = 5
"""Frames that are seen before an episode begins; the hand is moved by chance between them."""


@dataclass(frozen=True)
class Beginning:
    """Where an episode starts: a belief, and the robot's posture."""

    session: Session | None
    outputs: Mapping[str, Array]
    """Of the belief, as one row."""
    joints: Array
    """`[1, 7]`."""
    down: Array
    """How the hand is turned, `[1, 3, 3]`."""


class Robots:
    """The robots of rows, which know their postures."""

    def __init__(self, beginnings: Sequence[Beginning]) -> None:
        self.joints = np.concatenate([each.joints for each in beginnings])
        self._down = np.concatenate([each.down for each in beginnings])

    @property
    def hands(self) -> Array:
        """Places of hands on the table, `[rows, 2]` metres."""
        return arm.hands(self.joints)[0][:, :2]

    def act(self, ways: Array) -> Array:
        """The joint velocities that displace hands by `[rows, 2]`, in units of `REACH`; hands are there then."""
        speeds = arm.velocities(self.joints, REACH * ways, self._down)
        self.joints = self.joints + arm.PERIOD * speeds
        return speeds


class RobotTask(Task, Protocol):
    """A task whose policy has two numbers in [-1, 1] to say."""

    steps: int
    """Of an episode."""
    unit: str
    """Of distances from the goal."""
    robots: Robots

    def act(self, actions: Array) -> Array:
        """The joint velocities of a policy's actions `[rows, 2]`."""

    def truth(self, now: Observation) -> dict[str, Array]:
        """What the service would say if it knew the truth."""

    def draw(self, scene: Simulator, client: Client | None, seed: int) -> Any:
        """The goal of an episode in the simulator: as the service sees it or, without a client, as it is."""

    def pursue(self, goal: Any, beginning: Beginning, outputs: Mapping[str, Array]) -> None:
        """As `begin`, of one row, in the simulator."""

    def left(self, outputs: Mapping[str, Array]) -> float:
        """How far the first row is from its goal."""

    def mark(self) -> Array:
        """Where the first row's goal is in the picture, in [-1, 1]."""


def begin(
    scene: Simulator, client: Client | None, seed: int, outputs: Sequence[str] = ()
) -> tuple[Observation, Beginning]:
    """The episode of a seed after its first frames, and, with a client, what the service believes of them."""
    now = scene.reset(seed)
    session = client.create_session(label="imagination") if client else None
    _, down = arm.hands(joints(now))
    # Motions as the closed loops' search draws them first.
    ways = 0.7 * REACH * Icem(Budget(FRAMES - 1), REACH, np.random.default_rng([3, seed])).noise(1)[0]
    believed: Mapping[str, Array] = {}
    if session is not None:
        session.observe(np.array(now.rgb))
    for way in ways.clip(-REACH, REACH):
        action = arm.velocities(joints(now), way[None], down)[0]
        now = scene.step(action)
        if session is not None:
            believed = row(session.observe(np.array(now.rgb), action, outputs=outputs))
    return now, Beginning(session, believed, joints(now), down)


def joints(observation: Observation) -> Array:
    """Joint positions `[1, 7]`, which a robot knows of itself."""
    return np.array([observation.state["joint_positions"][:7]])


def row(belief: Belief) -> dict[str, Array]:
    """A belief as outputs of one row, as imagination has them."""
    table = np.array([
        [each.presence, each.x, each.y, each.width, each.height, each.depth] for each in belief.objects
    ]).reshape(1, -1, 6)
    found = {name: values[None] for name, values in belief.outputs.items()}
    return found | {"objects": table, "object_ids": np.array([[each.id for each in belief.objects]])}
