import datetime

from gatsbi_client._proto.gatsbi.v1 import cost_pb2 as _cost_pb2
from gatsbi_client._proto.gatsbi.v1 import goal_pb2 as _goal_pb2
from gatsbi_client._proto.gatsbi.v1 import output_pb2 as _output_pb2
from gatsbi_client._proto.gatsbi.v1 import step_pb2 as _step_pb2
from gatsbi_client._proto.gatsbi.v1 import tensor_pb2 as _tensor_pb2
from google.protobuf import duration_pb2 as _duration_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class StopReason(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    STOP_REASON_UNSPECIFIED: _ClassVar[StopReason]
    STOP_REASON_ITERATIONS: _ClassVar[StopReason]
    STOP_REASON_BUDGET: _ClassVar[StopReason]
STOP_REASON_UNSPECIFIED: StopReason
STOP_REASON_ITERATIONS: StopReason
STOP_REASON_BUDGET: StopReason

class ScoreRequest(_message.Message):
    __slots__ = ("session_id", "at_step", "actions", "sampling", "costs", "by_sample", "by_term", "timeout_millis")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    AT_STEP_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    SAMPLING_FIELD_NUMBER: _ClassVar[int]
    COSTS_FIELD_NUMBER: _ClassVar[int]
    BY_SAMPLE_FIELD_NUMBER: _ClassVar[int]
    BY_TERM_FIELD_NUMBER: _ClassVar[int]
    TIMEOUT_MILLIS_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    at_step: int
    actions: _tensor_pb2.Tensor
    sampling: _step_pb2.Sampling
    costs: _cost_pb2.CostProgram
    by_sample: bool
    by_term: bool
    timeout_millis: int
    def __init__(self, session_id: _Optional[str] = ..., at_step: _Optional[int] = ..., actions: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., sampling: _Optional[_Union[_step_pb2.Sampling, _Mapping]] = ..., costs: _Optional[_Union[_cost_pb2.CostProgram, _Mapping]] = ..., by_sample: bool = ..., by_term: bool = ..., timeout_millis: _Optional[int] = ...) -> None: ...

class ScoreResponse(_message.Message):
    __slots__ = ("at_step", "model_hash", "seed", "costs", "violations", "by_sample", "by_term", "best", "timing")
    AT_STEP_FIELD_NUMBER: _ClassVar[int]
    MODEL_HASH_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    COSTS_FIELD_NUMBER: _ClassVar[int]
    VIOLATIONS_FIELD_NUMBER: _ClassVar[int]
    BY_SAMPLE_FIELD_NUMBER: _ClassVar[int]
    BY_TERM_FIELD_NUMBER: _ClassVar[int]
    BEST_FIELD_NUMBER: _ClassVar[int]
    TIMING_FIELD_NUMBER: _ClassVar[int]
    at_step: int
    model_hash: str
    seed: int
    costs: _tensor_pb2.Tensor
    violations: _tensor_pb2.Tensor
    by_sample: _tensor_pb2.Tensor
    by_term: _tensor_pb2.Tensor
    best: int
    timing: _step_pb2.Timing
    def __init__(self, at_step: _Optional[int] = ..., model_hash: _Optional[str] = ..., seed: _Optional[int] = ..., costs: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., violations: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., by_sample: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., by_term: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., best: _Optional[int] = ..., timing: _Optional[_Union[_step_pb2.Timing, _Mapping]] = ...) -> None: ...

class PlanRequest(_message.Message):
    __slots__ = ("session_id", "at_step", "horizon", "costs", "action_min", "action_max", "action_repeat", "sampling", "random_shooting", "cem", "icem", "mppi", "warm_start", "budget_millis", "outputs")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    AT_STEP_FIELD_NUMBER: _ClassVar[int]
    HORIZON_FIELD_NUMBER: _ClassVar[int]
    COSTS_FIELD_NUMBER: _ClassVar[int]
    ACTION_MIN_FIELD_NUMBER: _ClassVar[int]
    ACTION_MAX_FIELD_NUMBER: _ClassVar[int]
    ACTION_REPEAT_FIELD_NUMBER: _ClassVar[int]
    SAMPLING_FIELD_NUMBER: _ClassVar[int]
    RANDOM_SHOOTING_FIELD_NUMBER: _ClassVar[int]
    CEM_FIELD_NUMBER: _ClassVar[int]
    ICEM_FIELD_NUMBER: _ClassVar[int]
    MPPI_FIELD_NUMBER: _ClassVar[int]
    WARM_START_FIELD_NUMBER: _ClassVar[int]
    BUDGET_MILLIS_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    at_step: int
    horizon: int
    costs: _cost_pb2.CostProgram
    action_min: _containers.RepeatedScalarFieldContainer[float]
    action_max: _containers.RepeatedScalarFieldContainer[float]
    action_repeat: int
    sampling: _step_pb2.Sampling
    random_shooting: RandomShooting
    cem: Cem
    icem: Icem
    mppi: Mppi
    warm_start: WarmStart
    budget_millis: int
    outputs: _output_pb2.OutputSelection
    def __init__(self, session_id: _Optional[str] = ..., at_step: _Optional[int] = ..., horizon: _Optional[int] = ..., costs: _Optional[_Union[_cost_pb2.CostProgram, _Mapping]] = ..., action_min: _Optional[_Iterable[float]] = ..., action_max: _Optional[_Iterable[float]] = ..., action_repeat: _Optional[int] = ..., sampling: _Optional[_Union[_step_pb2.Sampling, _Mapping]] = ..., random_shooting: _Optional[_Union[RandomShooting, _Mapping]] = ..., cem: _Optional[_Union[Cem, _Mapping]] = ..., icem: _Optional[_Union[Icem, _Mapping]] = ..., mppi: _Optional[_Union[Mppi, _Mapping]] = ..., warm_start: _Optional[_Union[WarmStart, _Mapping]] = ..., budget_millis: _Optional[int] = ..., outputs: _Optional[_Union[_output_pb2.OutputSelection, _Mapping]] = ...) -> None: ...

class RandomShooting(_message.Message):
    __slots__ = ("candidates",)
    CANDIDATES_FIELD_NUMBER: _ClassVar[int]
    candidates: int
    def __init__(self, candidates: _Optional[int] = ...) -> None: ...

class Cem(_message.Message):
    __slots__ = ("candidates", "iterations", "elites", "initial_std", "min_std", "momentum")
    CANDIDATES_FIELD_NUMBER: _ClassVar[int]
    ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    ELITES_FIELD_NUMBER: _ClassVar[int]
    INITIAL_STD_FIELD_NUMBER: _ClassVar[int]
    MIN_STD_FIELD_NUMBER: _ClassVar[int]
    MOMENTUM_FIELD_NUMBER: _ClassVar[int]
    candidates: int
    iterations: int
    elites: int
    initial_std: float
    min_std: float
    momentum: float
    def __init__(self, candidates: _Optional[int] = ..., iterations: _Optional[int] = ..., elites: _Optional[int] = ..., initial_std: _Optional[float] = ..., min_std: _Optional[float] = ..., momentum: _Optional[float] = ...) -> None: ...

class Icem(_message.Message):
    __slots__ = ("cem", "noise_beta", "keep_elites", "decay")
    CEM_FIELD_NUMBER: _ClassVar[int]
    NOISE_BETA_FIELD_NUMBER: _ClassVar[int]
    KEEP_ELITES_FIELD_NUMBER: _ClassVar[int]
    DECAY_FIELD_NUMBER: _ClassVar[int]
    cem: Cem
    noise_beta: float
    keep_elites: float
    decay: float
    def __init__(self, cem: _Optional[_Union[Cem, _Mapping]] = ..., noise_beta: _Optional[float] = ..., keep_elites: _Optional[float] = ..., decay: _Optional[float] = ...) -> None: ...

class Mppi(_message.Message):
    __slots__ = ("candidates", "iterations", "temperature", "noise_std", "noise_beta")
    CANDIDATES_FIELD_NUMBER: _ClassVar[int]
    ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    TEMPERATURE_FIELD_NUMBER: _ClassVar[int]
    NOISE_STD_FIELD_NUMBER: _ClassVar[int]
    NOISE_BETA_FIELD_NUMBER: _ClassVar[int]
    candidates: int
    iterations: int
    temperature: float
    noise_std: float
    noise_beta: float
    def __init__(self, candidates: _Optional[int] = ..., iterations: _Optional[int] = ..., temperature: _Optional[float] = ..., noise_std: _Optional[float] = ..., noise_beta: _Optional[float] = ...) -> None: ...

class WarmStart(_message.Message):
    __slots__ = ("previous", "actions")
    PREVIOUS_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    previous: bool
    actions: _tensor_pb2.Tensor
    def __init__(self, previous: bool = ..., actions: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ...) -> None: ...

class PlanResponse(_message.Message):
    __slots__ = ("at_step", "model_hash", "seed", "actions", "cost", "violation", "std", "best_costs", "iterations", "candidates", "stop", "outputs", "depths", "timing")
    AT_STEP_FIELD_NUMBER: _ClassVar[int]
    MODEL_HASH_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    COST_FIELD_NUMBER: _ClassVar[int]
    VIOLATION_FIELD_NUMBER: _ClassVar[int]
    STD_FIELD_NUMBER: _ClassVar[int]
    BEST_COSTS_FIELD_NUMBER: _ClassVar[int]
    ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    CANDIDATES_FIELD_NUMBER: _ClassVar[int]
    STOP_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    DEPTHS_FIELD_NUMBER: _ClassVar[int]
    TIMING_FIELD_NUMBER: _ClassVar[int]
    at_step: int
    model_hash: str
    seed: int
    actions: _tensor_pb2.Tensor
    cost: float
    violation: float
    std: _tensor_pb2.Tensor
    best_costs: _containers.RepeatedScalarFieldContainer[float]
    iterations: int
    candidates: int
    stop: StopReason
    outputs: _containers.RepeatedCompositeFieldContainer[_output_pb2.OutputValue]
    depths: _containers.RepeatedScalarFieldContainer[int]
    timing: _step_pb2.Timing
    def __init__(self, at_step: _Optional[int] = ..., model_hash: _Optional[str] = ..., seed: _Optional[int] = ..., actions: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., cost: _Optional[float] = ..., violation: _Optional[float] = ..., std: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., best_costs: _Optional[_Iterable[float]] = ..., iterations: _Optional[int] = ..., candidates: _Optional[int] = ..., stop: _Optional[_Union[StopReason, str]] = ..., outputs: _Optional[_Iterable[_Union[_output_pb2.OutputValue, _Mapping]]] = ..., depths: _Optional[_Iterable[int]] = ..., timing: _Optional[_Union[_step_pb2.Timing, _Mapping]] = ...) -> None: ...

class PutGoalRequest(_message.Message):
    __slots__ = ("model", "label", "image", "masks", "ttl")
    MODEL_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    MASKS_FIELD_NUMBER: _ClassVar[int]
    TTL_FIELD_NUMBER: _ClassVar[int]
    model: str
    label: str
    image: _tensor_pb2.Image
    masks: _containers.RepeatedCompositeFieldContainer[_goal_pb2.MaskGoal]
    ttl: _duration_pb2.Duration
    def __init__(self, model: _Optional[str] = ..., label: _Optional[str] = ..., image: _Optional[_Union[_tensor_pb2.Image, _Mapping]] = ..., masks: _Optional[_Iterable[_Union[_goal_pb2.MaskGoal, _Mapping]]] = ..., ttl: _Optional[_Union[datetime.timedelta, _duration_pb2.Duration, _Mapping]] = ...) -> None: ...

class PutGoalResponse(_message.Message):
    __slots__ = ("goal",)
    GOAL_FIELD_NUMBER: _ClassVar[int]
    goal: _goal_pb2.Goal
    def __init__(self, goal: _Optional[_Union[_goal_pb2.Goal, _Mapping]] = ...) -> None: ...

class DeleteGoalRequest(_message.Message):
    __slots__ = ("goal_id",)
    GOAL_ID_FIELD_NUMBER: _ClassVar[int]
    goal_id: str
    def __init__(self, goal_id: _Optional[str] = ...) -> None: ...

class DeleteGoalResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...
