"""Builders of common cost programs; the messages of `cost.proto` can be given as well."""

from __future__ import annotations

from gatsbi_client._proto.gatsbi.v1.cost_pb2 import (
    ActionMagnitude, CostProgram, CostTerm, GoalImage, Point, Subject, ToTarget, WHEN_EVERY_STEP, WHEN_LAST_STEP,
)

__all__ = ["CostProgram", "CostTerm", "action_magnitude", "goal_image", "program", "to_target"]


def program(*terms: CostTerm) -> CostProgram:
    """The weighted sum of terms."""
    return CostProgram(terms=terms)


def to_target(object_id: int, x: float, y: float, *, weight: float = 1.0, last_step: bool = False) -> CostTerm:
    """Distance of an object to a point in [-1, 1] of the image, x rightwards, y downwards."""
    measure = ToTarget(subject=Subject(object_id=object_id), target=Point(x=x, y=y))
    when = WHEN_LAST_STEP if last_step else WHEN_EVERY_STEP
    return CostTerm(name="to_target", weight=weight, when=when, to_target=measure)


def goal_image(goal_id: str, *, weight: float = 1.0) -> CostTerm:
    """Mean squared difference to the image of a goal."""
    return CostTerm(name="goal_image", weight=weight, goal_image=GoalImage(goal_id=goal_id))


def action_magnitude(*, weight: float = 1.0) -> CostTerm:
    """Squared size of actions."""
    return CostTerm(name="action_magnitude", weight=weight, action_magnitude=ActionMagnitude())
