from gatsbi_client._proto.gatsbi.v1 import goal_pb2 as _goal_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Risk(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    RISK_UNSPECIFIED: _ClassVar[Risk]
    RISK_MEAN: _ClassVar[Risk]
    RISK_WORST: _ClassVar[Risk]
    RISK_WORST_SHARE: _ClassVar[Risk]

class When(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    WHEN_UNSPECIFIED: _ClassVar[When]
    WHEN_EVERY_STEP: _ClassVar[When]
    WHEN_LAST_STEP: _ClassVar[When]
    WHEN_BEST_STEP: _ClassVar[When]

class Distance(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DISTANCE_UNSPECIFIED: _ClassVar[Distance]
    DISTANCE_EUCLIDEAN: _ClassVar[Distance]
    DISTANCE_SQUARED: _ClassVar[Distance]

class Pixels(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    PIXELS_UNSPECIFIED: _ClassVar[Pixels]
    PIXELS_ALL: _ClassVar[Pixels]
    PIXELS_AGENT: _ClassVar[Pixels]
    PIXELS_OBJECTS: _ClassVar[Pixels]
    PIXELS_BACKGROUND: _ClassVar[Pixels]
RISK_UNSPECIFIED: Risk
RISK_MEAN: Risk
RISK_WORST: Risk
RISK_WORST_SHARE: Risk
WHEN_UNSPECIFIED: When
WHEN_EVERY_STEP: When
WHEN_LAST_STEP: When
WHEN_BEST_STEP: When
DISTANCE_UNSPECIFIED: Distance
DISTANCE_EUCLIDEAN: Distance
DISTANCE_SQUARED: Distance
PIXELS_UNSPECIFIED: Pixels
PIXELS_ALL: Pixels
PIXELS_AGENT: Pixels
PIXELS_OBJECTS: Pixels
PIXELS_BACKGROUND: Pixels

class CostProgram(_message.Message):
    __slots__ = ("terms", "constraints", "discount", "risk", "worst_share", "missing_distance")
    TERMS_FIELD_NUMBER: _ClassVar[int]
    CONSTRAINTS_FIELD_NUMBER: _ClassVar[int]
    DISCOUNT_FIELD_NUMBER: _ClassVar[int]
    RISK_FIELD_NUMBER: _ClassVar[int]
    WORST_SHARE_FIELD_NUMBER: _ClassVar[int]
    MISSING_DISTANCE_FIELD_NUMBER: _ClassVar[int]
    terms: _containers.RepeatedCompositeFieldContainer[CostTerm]
    constraints: _containers.RepeatedCompositeFieldContainer[Constraint]
    discount: float
    risk: Risk
    worst_share: float
    missing_distance: float
    def __init__(self, terms: _Optional[_Iterable[_Union[CostTerm, _Mapping]]] = ..., constraints: _Optional[_Iterable[_Union[Constraint, _Mapping]]] = ..., discount: _Optional[float] = ..., risk: _Optional[_Union[Risk, str]] = ..., worst_share: _Optional[float] = ..., missing_distance: _Optional[float] = ...) -> None: ...

class CostTerm(_message.Message):
    __slots__ = ("name", "weight", "when", "to_target", "between", "goal_image", "goal_masks", "region", "overlap", "action_magnitude", "action_smoothness", "spread")
    NAME_FIELD_NUMBER: _ClassVar[int]
    WEIGHT_FIELD_NUMBER: _ClassVar[int]
    WHEN_FIELD_NUMBER: _ClassVar[int]
    TO_TARGET_FIELD_NUMBER: _ClassVar[int]
    BETWEEN_FIELD_NUMBER: _ClassVar[int]
    GOAL_IMAGE_FIELD_NUMBER: _ClassVar[int]
    GOAL_MASKS_FIELD_NUMBER: _ClassVar[int]
    REGION_FIELD_NUMBER: _ClassVar[int]
    OVERLAP_FIELD_NUMBER: _ClassVar[int]
    ACTION_MAGNITUDE_FIELD_NUMBER: _ClassVar[int]
    ACTION_SMOOTHNESS_FIELD_NUMBER: _ClassVar[int]
    SPREAD_FIELD_NUMBER: _ClassVar[int]
    name: str
    weight: float
    when: When
    to_target: ToTarget
    between: Between
    goal_image: GoalImage
    goal_masks: GoalMasks
    region: Region
    overlap: Overlap
    action_magnitude: ActionMagnitude
    action_smoothness: ActionSmoothness
    spread: SpreadPenalty
    def __init__(self, name: _Optional[str] = ..., weight: _Optional[float] = ..., when: _Optional[_Union[When, str]] = ..., to_target: _Optional[_Union[ToTarget, _Mapping]] = ..., between: _Optional[_Union[Between, _Mapping]] = ..., goal_image: _Optional[_Union[GoalImage, _Mapping]] = ..., goal_masks: _Optional[_Union[GoalMasks, _Mapping]] = ..., region: _Optional[_Union[Region, _Mapping]] = ..., overlap: _Optional[_Union[Overlap, _Mapping]] = ..., action_magnitude: _Optional[_Union[ActionMagnitude, _Mapping]] = ..., action_smoothness: _Optional[_Union[ActionSmoothness, _Mapping]] = ..., spread: _Optional[_Union[SpreadPenalty, _Mapping]] = ...) -> None: ...

class Constraint(_message.Message):
    __slots__ = ("term", "at_most")
    TERM_FIELD_NUMBER: _ClassVar[int]
    AT_MOST_FIELD_NUMBER: _ClassVar[int]
    term: CostTerm
    at_most: float
    def __init__(self, term: _Optional[_Union[CostTerm, _Mapping]] = ..., at_most: _Optional[float] = ...) -> None: ...

class Subject(_message.Message):
    __slots__ = ("object_id", "agent", "all_objects")
    OBJECT_ID_FIELD_NUMBER: _ClassVar[int]
    AGENT_FIELD_NUMBER: _ClassVar[int]
    ALL_OBJECTS_FIELD_NUMBER: _ClassVar[int]
    object_id: int
    agent: bool
    all_objects: bool
    def __init__(self, object_id: _Optional[int] = ..., agent: bool = ..., all_objects: bool = ...) -> None: ...

class Point(_message.Message):
    __slots__ = ("x", "y")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ...) -> None: ...

class ToTarget(_message.Message):
    __slots__ = ("subject", "target", "distance", "tolerance")
    SUBJECT_FIELD_NUMBER: _ClassVar[int]
    TARGET_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_FIELD_NUMBER: _ClassVar[int]
    TOLERANCE_FIELD_NUMBER: _ClassVar[int]
    subject: Subject
    target: Point
    distance: Distance
    tolerance: float
    def __init__(self, subject: _Optional[_Union[Subject, _Mapping]] = ..., target: _Optional[_Union[Point, _Mapping]] = ..., distance: _Optional[_Union[Distance, str]] = ..., tolerance: _Optional[float] = ...) -> None: ...

class Between(_message.Message):
    __slots__ = ("a", "b", "target_distance", "distance")
    A_FIELD_NUMBER: _ClassVar[int]
    B_FIELD_NUMBER: _ClassVar[int]
    TARGET_DISTANCE_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_FIELD_NUMBER: _ClassVar[int]
    a: Subject
    b: Subject
    target_distance: float
    distance: Distance
    def __init__(self, a: _Optional[_Union[Subject, _Mapping]] = ..., b: _Optional[_Union[Subject, _Mapping]] = ..., target_distance: _Optional[float] = ..., distance: _Optional[_Union[Distance, str]] = ...) -> None: ...

class GoalImage(_message.Message):
    __slots__ = ("goal_id", "pixels")
    GOAL_ID_FIELD_NUMBER: _ClassVar[int]
    PIXELS_FIELD_NUMBER: _ClassVar[int]
    goal_id: str
    pixels: Pixels
    def __init__(self, goal_id: _Optional[str] = ..., pixels: _Optional[_Union[Pixels, str]] = ...) -> None: ...

class GoalMasks(_message.Message):
    __slots__ = ("goal_id", "part")
    GOAL_ID_FIELD_NUMBER: _ClassVar[int]
    PART_FIELD_NUMBER: _ClassVar[int]
    goal_id: str
    part: _goal_pb2.MaskPart
    def __init__(self, goal_id: _Optional[str] = ..., part: _Optional[_Union[_goal_pb2.MaskPart, str]] = ...) -> None: ...

class Region(_message.Message):
    __slots__ = ("subject", "box", "keep_out")
    SUBJECT_FIELD_NUMBER: _ClassVar[int]
    BOX_FIELD_NUMBER: _ClassVar[int]
    KEEP_OUT_FIELD_NUMBER: _ClassVar[int]
    subject: Subject
    box: Box
    keep_out: bool
    def __init__(self, subject: _Optional[_Union[Subject, _Mapping]] = ..., box: _Optional[_Union[Box, _Mapping]] = ..., keep_out: bool = ...) -> None: ...

class Box(_message.Message):
    __slots__ = ("left", "top", "right", "bottom")
    LEFT_FIELD_NUMBER: _ClassVar[int]
    TOP_FIELD_NUMBER: _ClassVar[int]
    RIGHT_FIELD_NUMBER: _ClassVar[int]
    BOTTOM_FIELD_NUMBER: _ClassVar[int]
    left: float
    top: float
    right: float
    bottom: float
    def __init__(self, left: _Optional[float] = ..., top: _Optional[float] = ..., right: _Optional[float] = ..., bottom: _Optional[float] = ...) -> None: ...

class Overlap(_message.Message):
    __slots__ = ("a", "b")
    A_FIELD_NUMBER: _ClassVar[int]
    B_FIELD_NUMBER: _ClassVar[int]
    a: Subject
    b: Subject
    def __init__(self, a: _Optional[_Union[Subject, _Mapping]] = ..., b: _Optional[_Union[Subject, _Mapping]] = ...) -> None: ...

class ActionMagnitude(_message.Message):
    __slots__ = ("weights",)
    WEIGHTS_FIELD_NUMBER: _ClassVar[int]
    weights: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, weights: _Optional[_Iterable[float]] = ...) -> None: ...

class ActionSmoothness(_message.Message):
    __slots__ = ("weights", "previous")
    WEIGHTS_FIELD_NUMBER: _ClassVar[int]
    PREVIOUS_FIELD_NUMBER: _ClassVar[int]
    weights: _containers.RepeatedScalarFieldContainer[float]
    previous: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, weights: _Optional[_Iterable[float]] = ..., previous: _Optional[_Iterable[float]] = ...) -> None: ...

class SpreadPenalty(_message.Message):
    __slots__ = ("subject",)
    SUBJECT_FIELD_NUMBER: _ClassVar[int]
    subject: Subject
    def __init__(self, subject: _Optional[_Union[Subject, _Mapping]] = ...) -> None: ...
