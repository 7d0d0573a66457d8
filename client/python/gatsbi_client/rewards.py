"""Rewards over imagined objects, and the shapes of imagined worlds that adapters share."""

from __future__ import annotations

from typing import Any, Callable, Mapping

import numpy as np
import numpy.typing as npt

from gatsbi_client.types import Array, Floats, Model

Reward = Callable[[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]], npt.NDArray[Any]]
"""From object ids `[rows, MAX]`, objects `[rows, MAX, 6]` and actions `[rows, A]` to rewards `[rows]`."""


def object_to_target(object_id: int, x: float, y: float) -> Reward:
    """Minus the distance of an object to a point in [-1, 1]; -2 where the object is not present."""

    def reward(ids: npt.NDArray[Any], objects: npt.NDArray[Any], _: npt.NDArray[Any]) -> npt.NDArray[Any]:
        here = (ids == object_id) & (objects[..., 0] >= 0.5)
        distance = np.hypot(objects[..., 1] - x, objects[..., 2] - y)
        return np.asarray(-np.where(here, distance, 2.0).min(axis=1))

    return reward


def neutral_action(model: Model) -> Floats:
    """The action that is zero to the network, raw units `[A]`."""
    return np.array([each.offset for each in model.actions], dtype=np.float32)


def action_bounds(model: Model) -> tuple[Floats, Floats]:
    """Two scales around the neutral action, raw units `[A]`: what planning searches by default."""
    reach = 2 * np.abs([each.scale for each in model.actions], dtype=np.float32)
    return neutral_action(model) - reach, neutral_action(model) + reach


def visible(outputs: Mapping[str, Array]) -> Floats:
    """The objects `[rows, MAX, 6]`, with zeros in slots that were never filled."""
    return np.where(outputs["object_ids"][..., None] >= 0, outputs["objects"], 0).astype(np.float32)


def mask_centres(masks: Array) -> Floats:
    """Centres `[..., 2]` of masks `[..., H, W]`: x rightwards and y downwards in [-1, 1]; (0, 0) of empty ones."""
    weights = masks.astype(np.float32)
    height, width = weights.shape[-2:]
    total = np.maximum(weights.sum(axis=(-2, -1)), 1e-9)
    x = (weights.sum(axis=-2) @ ((np.arange(width) + 0.5) * 2 / width - 1)) / total
    y = (weights.sum(axis=-1) @ ((np.arange(height) + 0.5) * 2 / height - 1)) / total
    empty = total < 1e-6
    return np.where(empty[..., None], 0, np.stack([x, y], axis=-1)).astype(np.float32)
