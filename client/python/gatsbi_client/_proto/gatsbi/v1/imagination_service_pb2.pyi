import datetime

from gatsbi_client._proto.gatsbi.v1 import cost_pb2 as _cost_pb2
from gatsbi_client._proto.gatsbi.v1 import output_pb2 as _output_pb2
from gatsbi_client._proto.gatsbi.v1 import problem_pb2 as _problem_pb2
from gatsbi_client._proto.gatsbi.v1 import step_pb2 as _step_pb2
from gatsbi_client._proto.gatsbi.v1 import tensor_pb2 as _tensor_pb2
from google.protobuf import duration_pb2 as _duration_pb2
from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ImagineRequest(_message.Message):
    __slots__ = ("session_id", "at_step", "actions", "sampling", "outputs", "costs", "timeout_millis")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    AT_STEP_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    SAMPLING_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    COSTS_FIELD_NUMBER: _ClassVar[int]
    TIMEOUT_MILLIS_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    at_step: int
    actions: _tensor_pb2.Tensor
    sampling: _step_pb2.Sampling
    outputs: _output_pb2.OutputSelection
    costs: _cost_pb2.CostProgram
    timeout_millis: int
    def __init__(self, session_id: _Optional[str] = ..., at_step: _Optional[int] = ..., actions: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., sampling: _Optional[_Union[_step_pb2.Sampling, _Mapping]] = ..., outputs: _Optional[_Union[_output_pb2.OutputSelection, _Mapping]] = ..., costs: _Optional[_Union[_cost_pb2.CostProgram, _Mapping]] = ..., timeout_millis: _Optional[int] = ...) -> None: ...

class ImagineResponse(_message.Message):
    __slots__ = ("chunk",)
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    chunk: RolloutChunk
    def __init__(self, chunk: _Optional[_Union[RolloutChunk, _Mapping]] = ...) -> None: ...

class RolloutChunk(_message.Message):
    __slots__ = ("at_step", "model_hash", "seed", "sample", "first_candidate", "candidates", "depths", "outputs", "last", "timing", "over_samples")
    AT_STEP_FIELD_NUMBER: _ClassVar[int]
    MODEL_HASH_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    SAMPLE_FIELD_NUMBER: _ClassVar[int]
    FIRST_CANDIDATE_FIELD_NUMBER: _ClassVar[int]
    CANDIDATES_FIELD_NUMBER: _ClassVar[int]
    DEPTHS_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    LAST_FIELD_NUMBER: _ClassVar[int]
    TIMING_FIELD_NUMBER: _ClassVar[int]
    OVER_SAMPLES_FIELD_NUMBER: _ClassVar[int]
    at_step: int
    model_hash: str
    seed: int
    sample: int
    first_candidate: int
    candidates: int
    depths: _containers.RepeatedScalarFieldContainer[int]
    outputs: _containers.RepeatedCompositeFieldContainer[_output_pb2.OutputValue]
    last: bool
    timing: _step_pb2.Timing
    over_samples: bool
    def __init__(self, at_step: _Optional[int] = ..., model_hash: _Optional[str] = ..., seed: _Optional[int] = ..., sample: _Optional[int] = ..., first_candidate: _Optional[int] = ..., candidates: _Optional[int] = ..., depths: _Optional[_Iterable[int]] = ..., outputs: _Optional[_Iterable[_Union[_output_pb2.OutputValue, _Mapping]]] = ..., last: bool = ..., timing: _Optional[_Union[_step_pb2.Timing, _Mapping]] = ..., over_samples: bool = ...) -> None: ...

class Start(_message.Message):
    __slots__ = ("session", "snapshot", "context")
    SESSION_FIELD_NUMBER: _ClassVar[int]
    SNAPSHOT_FIELD_NUMBER: _ClassVar[int]
    CONTEXT_FIELD_NUMBER: _ClassVar[int]
    session: SessionStart
    snapshot: bytes
    context: Context
    def __init__(self, session: _Optional[_Union[SessionStart, _Mapping]] = ..., snapshot: _Optional[bytes] = ..., context: _Optional[_Union[Context, _Mapping]] = ...) -> None: ...

class SessionStart(_message.Message):
    __slots__ = ("session_id", "at_step")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    AT_STEP_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    at_step: int
    def __init__(self, session_id: _Optional[str] = ..., at_step: _Optional[int] = ...) -> None: ...

class Context(_message.Message):
    __slots__ = ("model", "frames", "actions", "seed")
    MODEL_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    model: str
    frames: _tensor_pb2.Tensor
    actions: _tensor_pb2.Tensor
    seed: int
    def __init__(self, model: _Optional[str] = ..., frames: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., actions: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., seed: _Optional[int] = ...) -> None: ...

class PredictBatchRequest(_message.Message):
    __slots__ = ("key", "start", "actions", "sampling", "outputs", "costs")
    KEY_FIELD_NUMBER: _ClassVar[int]
    START_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    SAMPLING_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    COSTS_FIELD_NUMBER: _ClassVar[int]
    key: int
    start: Start
    actions: _tensor_pb2.Tensor
    sampling: _step_pb2.Sampling
    outputs: _output_pb2.OutputSelection
    costs: _cost_pb2.CostProgram
    def __init__(self, key: _Optional[int] = ..., start: _Optional[_Union[Start, _Mapping]] = ..., actions: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., sampling: _Optional[_Union[_step_pb2.Sampling, _Mapping]] = ..., outputs: _Optional[_Union[_output_pb2.OutputSelection, _Mapping]] = ..., costs: _Optional[_Union[_cost_pb2.CostProgram, _Mapping]] = ...) -> None: ...

class PredictBatchResponse(_message.Message):
    __slots__ = ("key", "chunk", "problem")
    KEY_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    PROBLEM_FIELD_NUMBER: _ClassVar[int]
    key: int
    chunk: RolloutChunk
    problem: _problem_pb2.Problem
    def __init__(self, key: _Optional[int] = ..., chunk: _Optional[_Union[RolloutChunk, _Mapping]] = ..., problem: _Optional[_Union[_problem_pb2.Problem, _Mapping]] = ...) -> None: ...

class OpenHandlesRequest(_message.Message):
    __slots__ = ("starts", "sampling", "ttl")
    STARTS_FIELD_NUMBER: _ClassVar[int]
    SAMPLING_FIELD_NUMBER: _ClassVar[int]
    TTL_FIELD_NUMBER: _ClassVar[int]
    starts: _containers.RepeatedCompositeFieldContainer[Start]
    sampling: _step_pb2.Sampling
    ttl: _duration_pb2.Duration
    def __init__(self, starts: _Optional[_Iterable[_Union[Start, _Mapping]]] = ..., sampling: _Optional[_Union[_step_pb2.Sampling, _Mapping]] = ..., ttl: _Optional[_Union[datetime.timedelta, _duration_pb2.Duration, _Mapping]] = ...) -> None: ...

class OpenHandlesResponse(_message.Message):
    __slots__ = ("handles_id", "rows", "model_hash", "seed", "expires_at")
    HANDLES_ID_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    MODEL_HASH_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    EXPIRES_AT_FIELD_NUMBER: _ClassVar[int]
    handles_id: str
    rows: int
    model_hash: str
    seed: int
    expires_at: _timestamp_pb2.Timestamp
    def __init__(self, handles_id: _Optional[str] = ..., rows: _Optional[int] = ..., model_hash: _Optional[str] = ..., seed: _Optional[int] = ..., expires_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ...) -> None: ...

class StepHandlesRequest(_message.Message):
    __slots__ = ("handles_id", "step", "rows", "actions", "restart", "outputs", "timeout_millis")
    HANDLES_ID_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    RESTART_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    TIMEOUT_MILLIS_FIELD_NUMBER: _ClassVar[int]
    handles_id: str
    step: int
    rows: _containers.RepeatedScalarFieldContainer[int]
    actions: _tensor_pb2.Tensor
    restart: _containers.RepeatedScalarFieldContainer[int]
    outputs: _output_pb2.OutputSelection
    timeout_millis: int
    def __init__(self, handles_id: _Optional[str] = ..., step: _Optional[int] = ..., rows: _Optional[_Iterable[int]] = ..., actions: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., restart: _Optional[_Iterable[int]] = ..., outputs: _Optional[_Union[_output_pb2.OutputSelection, _Mapping]] = ..., timeout_millis: _Optional[int] = ...) -> None: ...

class StepHandlesResponse(_message.Message):
    __slots__ = ("step", "model_hash", "outputs", "timing")
    STEP_FIELD_NUMBER: _ClassVar[int]
    MODEL_HASH_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    TIMING_FIELD_NUMBER: _ClassVar[int]
    step: int
    model_hash: str
    outputs: _containers.RepeatedCompositeFieldContainer[_output_pb2.OutputValue]
    timing: _step_pb2.Timing
    def __init__(self, step: _Optional[int] = ..., model_hash: _Optional[str] = ..., outputs: _Optional[_Iterable[_Union[_output_pb2.OutputValue, _Mapping]]] = ..., timing: _Optional[_Union[_step_pb2.Timing, _Mapping]] = ...) -> None: ...

class CloseHandlesRequest(_message.Message):
    __slots__ = ("handles_id",)
    HANDLES_ID_FIELD_NUMBER: _ClassVar[int]
    handles_id: str
    def __init__(self, handles_id: _Optional[str] = ...) -> None: ...

class CloseHandlesResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...
