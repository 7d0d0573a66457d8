"""Goals: which object shall be pushed where. A goal follows from its number alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from gatsbi_sim import Simulator

SCENE = "push1"
SIZE = 64
FIRST_SEED = 900_000
"""The data sets that models are trained on have seeds of their own; these are none of them."""
# Of the tray of push1, metres (sim/src/robot/catalogue.rs).
CENTRE, HALF = np.array([0.52, 0.0]), np.array([0.24, 0.28])
# A goal keeps this far from the rim and from the other objects, and the hand must have room to begin the push.
TARGET_MARGIN, BEGIN_MARGIN, CLEARANCE = 0.08, 0.04, 0.09
BEGIN = 0.1
"""Distance behind an object at which a push begins."""
DISTANCES = (0.08, 0.14)
TRIES = 1000
"""In vain, after which a goal without room is taken."""
AROUND = 0.09
"""Distance at which the hand goes around an object, metres."""
CLICK = 0.15
"""A box this near to a click is meant by it; half the picture's side is 1."""
LOST = 0.25
"""An object that was seen more than this far from where it was before is another one."""
SUCCESS = 0.03
"""An object this near to its target is there; metres."""


@dataclass(frozen=True)
class Goal:
    """Push object `named` to `target`."""

    number: int
    seed: int
    named: int
    target: tuple[float, float]
    """Metres on the table."""
    pixel: tuple[float, float]
    """Where the object's centre then appears."""
    distance: float
    """How far it is away at first, metres."""

    def set(self, scene: Simulator, objects: int) -> None:
        """Tells the scene, which from then on measures the distance."""
        scene.set_goal([self.target if each == self.named else None for each in range(objects)])


def draw(scene: Simulator, number: int) -> Goal:
    """The goal of this number."""
    rng, seed = np.random.default_rng([7, number]), FIRST_SEED + number
    places = np.array([each["position"][:2] for each in scene.reset(seed).state["objects"]])
    named, target, distance = pick(places, rng)
    shown = scene.set_goal([target if each == named else None for each in range(len(places))])
    pixel = shown.state["objects"][named]["pixel"]
    return Goal(number, seed, named, (float(target[0]), float(target[1])), (pixel[0], pixel[1]), distance)


def pick(places: np.ndarray, rng: np.random.Generator) -> tuple[int, np.ndarray, float]:
    """Which of the objects at `[n, 2]` metres is pushed, where to, and how far: with room for it at the target and for
    the hand where the push begins, if there is any."""
    for _ in range(TRIES):
        named = int(rng.integers(len(places)))
        angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(*DISTANCES)
        along = np.array([np.cos(angle), np.sin(angle)])
        target, begin = places[named] + along * distance, places[named] - along * BEGIN
        others = np.delete(places, named, axis=0)
        clear = (np.linalg.norm(others[:, None] - [target, begin], axis=-1) > CLEARANCE).all()
        if clear and _inside(target, TARGET_MARGIN) and _inside(begin, BEGIN_MARGIN):
            break
    return named, target, distance


def unready(hands: np.ndarray, place: np.ndarray, target: np.ndarray) -> np.ndarray:
    """How far hands `[..., 2]` have to go around an object, to its side away from the target; metres."""
    way, hands = target - place, hands - place
    far, left = np.linalg.norm(hands, axis=-1), np.linalg.norm(way, axis=-1)
    cosine = -(hands * way).sum(axis=-1) / np.maximum(far * left, 1e-9)
    return np.hypot(np.maximum(far - AROUND, 0), AROUND * np.arccos(cosine.clip(-1, 1)))


def in_image(pixel: object) -> np.ndarray:
    """Pixels `[..., 2]` as positions in [-1, 1], which is how the service tells them."""
    return (np.asarray(pixel) + 0.5) * 2 / SIZE - 1


class Table:
    """From the picture to the table: a homography, calibrated by positions of the hand that are seen at known places.

    The hand's point between the fingertips moves at the height of the objects' centres, 3 cm.
    """

    def __init__(self, scene: Simulator) -> None:
        ways = np.random.default_rng(0).uniform(-0.06, 0.06, (4, 6, 2))
        seen = [step for way in scene.hand_moves(ways) for step in way]
        rows = []
        for step in seen:
            (u, v), (x, y) = in_image(step["pixel"]), step["position"][:2]
            rows += [[u, v, 1, 0, 0, 0, -x * u, -x * v, -x], [0, 0, 0, u, v, 1, -y * u, -y * v, -y]]
        self._matrix = np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3)

    def metres(self, at: np.ndarray) -> np.ndarray:
        """Places on the table, metres, of positions `[..., 2]` in [-1, 1]."""
        return _mapped(self._matrix, at)

    def picture(self, place: np.ndarray) -> np.ndarray:
        """Positions in [-1, 1] of places `[..., 2]` on the table."""
        return _mapped(np.linalg.inv(self._matrix), place)


def _mapped(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    to = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1) @ matrix.T
    return to[..., :2] / to[..., 2:]


def _inside(point: np.ndarray, margin: float) -> bool:
    return bool((np.abs(point - CENTRE) <= HALF - margin).all())
