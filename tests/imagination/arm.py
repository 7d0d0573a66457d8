"""What a Panda knows of itself: which joint velocities move its hand in the plane of the table, many arms at once."""

from __future__ import annotations

import numpy as np

from goals import CENTRE, HALF

Array = np.ndarray

PERIOD = 0.2
"""Seconds for which an action is held."""
FASTEST = 2.1
"""Joints are slowed down together to this, rad/s."""
HEIGHT = 0.03
"""Of the point between the fingertips over the table, metres."""
MARGIN = 0.035
"""How far it stays from the tray's rim, metres."""
HOME = np.array([0.0, 0.2, 0.0, -2.1, 0.0, 2.3, 0.785])
# Each joint's frame in the one before: its origin, and the turn about x in quarters.
ORIGINS = np.array([
    [0, 0, 0.333], [0, 0, 0], [0, -0.316, 0], [0.0825, 0, 0], [-0.0825, 0.384, 0], [0, 0, 0], [0.088, 0, 0],
])
QUARTERS = [0, -1, 1, 1, -1, 1, 1]
REACH = 0.2035
"""From the last joint to the point between the fingertips, metres."""
ROUNDS, DAMPING, LEANING, LARGEST_TURN = 12, 1e-4, 0.1, 0.3


def velocities(joints: Array, displacements: Array, down: Array) -> Array:
    """Joint velocities `[N, 7]` that displace hands by `[N, 2]` metres; hands stay in the tray and turned as `down`."""
    hand, _ = hands(joints)
    low, high = CENTRE - HALF + MARGIN, CENTRE + HALF - MARGIN
    goal = np.column_stack([np.clip(hand[:, :2] + displacements, low, high), np.full(len(hand), HEIGHT)])
    turned = joints.copy()
    for _ in range(ROUNDS):
        at, axes, jacobian = _kinematics(turned)
        error = np.concatenate([goal - at, np.cross(axes, down, axis=1).sum(axis=2) / 2], axis=1)
        leaning = LEANING * (HOME - turned)
        normal = jacobian @ jacobian.transpose(0, 2, 1) + DAMPING * np.eye(6)
        lacking = error - (jacobian @ leaning[..., None])[..., 0]
        turn = leaning + (jacobian.transpose(0, 2, 1) @ np.linalg.solve(normal, lacking[..., None]))[..., 0]
        turned = turned + turn * np.minimum(LARGEST_TURN / np.abs(turn).max(axis=1, keepdims=True), 1)
    found = (turned - joints) / PERIOD
    return found * np.minimum(FASTEST / np.maximum(np.abs(found).max(axis=1, keepdims=True), 1e-9), 1)


def hands(joints: Array) -> tuple[Array, Array]:
    """Places `[N, 3]` of hands and their axes `[N, 3, 3]` (columns), of joint positions `[N, 7]`."""
    at, axes, _ = _kinematics(joints)
    return at, axes


def _kinematics(joints: Array) -> tuple[Array, Array, Array]:
    count = len(joints)
    at, axes = np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))
    origins, directions = [], []
    for joint in range(7):
        at = at + axes @ ORIGINS[joint]
        quarter = float(QUARTERS[joint])
        axes = axes @ np.array([[1, 0, 0], [0, 1 - abs(quarter), -quarter], [0, quarter, 1 - abs(quarter)]])
        cosine, sine = np.cos(joints[:, joint]), np.sin(joints[:, joint])
        turn = np.zeros((count, 3, 3))
        turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = cosine, -sine, sine, cosine
        turn[:, 2, 2] = 1
        axes = axes @ turn
        origins.append(at)
        directions.append(axes[:, :, 2])
    at = at + REACH * axes[:, :, 2]
    columns = [
        np.concatenate([np.cross(direction, at - origin), direction], axis=1)
        for origin, direction in zip(origins, directions)
    ]
    return at, axes, np.stack(columns, axis=2)
