"""Builders of cost programs. Smaller is better; positions are in [-1, 1] of the image, x rightwards, y downwards.

A subject is an object's id, `"agent"` or `"all_objects"`.
"""

from __future__ import annotations

from typing import Literal, Sequence

from gatsbi_client._proto.gatsbi.v1 import cost_pb2 as pb
from gatsbi_client._proto.gatsbi.v1.cost_pb2 import Constraint, CostProgram, CostTerm

__all__ = [
    "Constraint", "CostProgram", "CostTerm", "action_magnitude", "action_smoothness", "at_most", "between", "goal_image",
    "goal_masks", "overlap", "program", "region", "spread", "to_target",
]

Who = int | Literal["agent", "all_objects"]
When = Literal["every_step", "last_step", "best_step"]
Risk = Literal["mean", "worst", "worst_share"]


def program(
    *terms: CostTerm, constraints: Sequence[Constraint] = (), discount: float | None = None, risk: Risk = "mean",
    worst_share: float | None = None, missing_distance: float | None = None,
) -> CostProgram:
    """The weighted sum of terms, under constraints. `risk`: how samples of a candidate become one number."""
    return CostProgram(
        terms=terms, constraints=constraints, discount=discount, risk=f"RISK_{risk.upper()}",
        worst_share=worst_share, missing_distance=missing_distance,
    )


def at_most(term: CostTerm, limit: float) -> Constraint:
    """What a term measures must not be more than `limit` at any step that it looks at; its weight is not used."""
    return Constraint(term=term, at_most=limit)


def to_target(
    who: Who, x: float, y: float, *, weight: float = 1.0, when: When = "every_step", tolerance: float = 0.0,
    squared: bool = False,
) -> CostTerm:
    """Distance to a point, beyond a tolerance."""
    measure = pb.ToTarget(
        subject=_subject(who), target=pb.Point(x=x, y=y), tolerance=tolerance, distance=_distance(squared)
    )
    return CostTerm(name="to_target", weight=weight, when=_when(when), to_target=measure)


def between(
    a: Who, b: Who, distance: float = 0.0, *, weight: float = 1.0, when: When = "every_step", squared: bool = False,
) -> CostTerm:
    """Difference of the distance between two from what it should be."""
    measure = pb.Between(a=_subject(a), b=_subject(b), target_distance=distance, distance=_distance(squared))
    return CostTerm(name="between", weight=weight, when=_when(when), between=measure)


def region(
    who: Who, left: float, top: float, right: float, bottom: float, *, keep_out: bool = False, weight: float = 1.0,
    when: When = "every_step",
) -> CostTerm:
    """Distance to the nearest place inside a box, or outside of it."""
    box = pb.Box(left=left, top=top, right=right, bottom=bottom)
    measure = pb.Region(subject=_subject(who), box=box, keep_out=keep_out)
    return CostTerm(name="region", weight=weight, when=_when(when), region=measure)


def overlap(a: Who, b: Who, *, weight: float = 1.0, when: When = "every_step") -> CostTerm:
    """Share of the smaller one's bounding box that the other's covers."""
    measure = pb.Overlap(a=_subject(a), b=_subject(b))
    return CostTerm(name="overlap", weight=weight, when=_when(when), overlap=measure)


def action_magnitude(weights: Sequence[float] = (), *, weight: float = 1.0, when: When = "every_step") -> CostTerm:
    """Squared size of actions, each divided by its scale; `weights` by dimension."""
    measure = pb.ActionMagnitude(weights=weights)
    return CostTerm(name="action_magnitude", weight=weight, when=_when(when), action_magnitude=measure)


def action_smoothness(
    weights: Sequence[float] = (), *, previous: Sequence[float] = (), weight: float = 1.0, when: When = "every_step",
) -> CostTerm:
    """Squared change of actions, each divided by its scale; `previous` is the action before the first."""
    measure = pb.ActionSmoothness(weights=weights, previous=previous)
    return CostTerm(name="action_smoothness", weight=weight, when=_when(when), action_smoothness=measure)


def spread(who: Who, *, weight: float = 1.0, when: When = "every_step") -> CostTerm:
    """Standard deviation of a position over samples."""
    return CostTerm(name="spread", weight=weight, when=_when(when), spread=pb.SpreadPenalty(subject=_subject(who)))


def goal_image(
    goal_id: str, *, pixels: Literal["all", "agent", "objects", "background"] = "all", weight: float = 1.0,
    when: When = "every_step",
) -> CostTerm:
    """Mean squared difference to the image of a goal."""
    measure = pb.GoalImage(goal_id=goal_id, pixels=f"PIXELS_{pixels.upper()}")
    return CostTerm(name="goal_image", weight=weight, when=_when(when), goal_image=measure)


def goal_masks(
    goal_id: str, *, part: Literal["all_objects", "each_object", "agent"] = "all_objects", weight: float = 1.0,
    when: When = "every_step",
) -> CostTerm:
    """1 - intersection over union of masks with those of a goal."""
    measure = pb.GoalMasks(goal_id=goal_id, part=f"MASK_PART_{part.upper()}")
    return CostTerm(name="goal_masks", weight=weight, when=_when(when), goal_masks=measure)


def _subject(who: Who) -> pb.Subject:
    if who == "agent":
        return pb.Subject(agent=True)
    if who == "all_objects":
        return pb.Subject(all_objects=True)
    return pb.Subject(object_id=int(who))


def _when(when: When) -> str:
    return f"WHEN_{when.upper()}"


def _distance(squared: bool) -> pb.Distance:
    return pb.DISTANCE_SQUARED if squared else pb.DISTANCE_EUCLIDEAN
