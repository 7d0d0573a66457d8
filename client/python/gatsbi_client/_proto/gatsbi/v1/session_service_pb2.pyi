import datetime

from gatsbi_client._proto.gatsbi.v1 import output_pb2 as _output_pb2
from gatsbi_client._proto.gatsbi.v1 import problem_pb2 as _problem_pb2
from gatsbi_client._proto.gatsbi.v1 import step_pb2 as _step_pb2
from google.protobuf import duration_pb2 as _duration_pb2
from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Session(_message.Message):
    __slots__ = ("id", "label", "model", "model_hash", "next_step", "mode", "seed", "created_at", "used_at", "expires_at", "bytes", "keep_steps", "keep_frames", "oldest_step", "latest_wins")
    ID_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    MODEL_HASH_FIELD_NUMBER: _ClassVar[int]
    NEXT_STEP_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    CREATED_AT_FIELD_NUMBER: _ClassVar[int]
    USED_AT_FIELD_NUMBER: _ClassVar[int]
    EXPIRES_AT_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    KEEP_STEPS_FIELD_NUMBER: _ClassVar[int]
    KEEP_FRAMES_FIELD_NUMBER: _ClassVar[int]
    OLDEST_STEP_FIELD_NUMBER: _ClassVar[int]
    LATEST_WINS_FIELD_NUMBER: _ClassVar[int]
    id: str
    label: str
    model: str
    model_hash: str
    next_step: int
    mode: _step_pb2.Mode
    seed: int
    created_at: _timestamp_pb2.Timestamp
    used_at: _timestamp_pb2.Timestamp
    expires_at: _timestamp_pb2.Timestamp
    bytes: int
    keep_steps: int
    keep_frames: int
    oldest_step: int
    latest_wins: bool
    def __init__(self, id: _Optional[str] = ..., label: _Optional[str] = ..., model: _Optional[str] = ..., model_hash: _Optional[str] = ..., next_step: _Optional[int] = ..., mode: _Optional[_Union[_step_pb2.Mode, str]] = ..., seed: _Optional[int] = ..., created_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., used_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., expires_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., bytes: _Optional[int] = ..., keep_steps: _Optional[int] = ..., keep_frames: _Optional[int] = ..., oldest_step: _Optional[int] = ..., latest_wins: bool = ...) -> None: ...

class CreateSessionRequest(_message.Message):
    __slots__ = ("model", "label", "mode", "seed", "ttl", "keep_steps", "keep_frames", "latest_wins")
    MODEL_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    TTL_FIELD_NUMBER: _ClassVar[int]
    KEEP_STEPS_FIELD_NUMBER: _ClassVar[int]
    KEEP_FRAMES_FIELD_NUMBER: _ClassVar[int]
    LATEST_WINS_FIELD_NUMBER: _ClassVar[int]
    model: str
    label: str
    mode: _step_pb2.Mode
    seed: int
    ttl: _duration_pb2.Duration
    keep_steps: int
    keep_frames: int
    latest_wins: bool
    def __init__(self, model: _Optional[str] = ..., label: _Optional[str] = ..., mode: _Optional[_Union[_step_pb2.Mode, str]] = ..., seed: _Optional[int] = ..., ttl: _Optional[_Union[datetime.timedelta, _duration_pb2.Duration, _Mapping]] = ..., keep_steps: _Optional[int] = ..., keep_frames: _Optional[int] = ..., latest_wins: bool = ...) -> None: ...

class CreateSessionResponse(_message.Message):
    __slots__ = ("session",)
    SESSION_FIELD_NUMBER: _ClassVar[int]
    session: Session
    def __init__(self, session: _Optional[_Union[Session, _Mapping]] = ...) -> None: ...

class GetSessionRequest(_message.Message):
    __slots__ = ("session_id",)
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    def __init__(self, session_id: _Optional[str] = ...) -> None: ...

class GetSessionResponse(_message.Message):
    __slots__ = ("session",)
    SESSION_FIELD_NUMBER: _ClassVar[int]
    session: Session
    def __init__(self, session: _Optional[_Union[Session, _Mapping]] = ...) -> None: ...

class ListSessionsRequest(_message.Message):
    __slots__ = ("page_size", "page_token", "label")
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    page_size: int
    page_token: str
    label: str
    def __init__(self, page_size: _Optional[int] = ..., page_token: _Optional[str] = ..., label: _Optional[str] = ...) -> None: ...

class ListSessionsResponse(_message.Message):
    __slots__ = ("sessions", "next_page_token")
    SESSIONS_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    sessions: _containers.RepeatedCompositeFieldContainer[Session]
    next_page_token: str
    def __init__(self, sessions: _Optional[_Iterable[_Union[Session, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class DeleteSessionRequest(_message.Message):
    __slots__ = ("session_id",)
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    def __init__(self, session_id: _Optional[str] = ...) -> None: ...

class DeleteSessionResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ObserveRequest(_message.Message):
    __slots__ = ("session_id", "observation", "outputs", "timeout_millis")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    OBSERVATION_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    TIMEOUT_MILLIS_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    observation: _step_pb2.Observation
    outputs: _output_pb2.OutputSelection
    timeout_millis: int
    def __init__(self, session_id: _Optional[str] = ..., observation: _Optional[_Union[_step_pb2.Observation, _Mapping]] = ..., outputs: _Optional[_Union[_output_pb2.OutputSelection, _Mapping]] = ..., timeout_millis: _Optional[int] = ...) -> None: ...

class ObserveResponse(_message.Message):
    __slots__ = ("belief",)
    BELIEF_FIELD_NUMBER: _ClassVar[int]
    belief: _step_pb2.Belief
    def __init__(self, belief: _Optional[_Union[_step_pb2.Belief, _Mapping]] = ...) -> None: ...

class ObserveStreamRequest(_message.Message):
    __slots__ = ("session_id", "observation", "outputs", "timeout_millis")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    OBSERVATION_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    TIMEOUT_MILLIS_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    observation: _step_pb2.Observation
    outputs: _output_pb2.OutputSelection
    timeout_millis: int
    def __init__(self, session_id: _Optional[str] = ..., observation: _Optional[_Union[_step_pb2.Observation, _Mapping]] = ..., outputs: _Optional[_Union[_output_pb2.OutputSelection, _Mapping]] = ..., timeout_millis: _Optional[int] = ...) -> None: ...

class ObserveStreamResponse(_message.Message):
    __slots__ = ("belief", "problem")
    BELIEF_FIELD_NUMBER: _ClassVar[int]
    PROBLEM_FIELD_NUMBER: _ClassVar[int]
    belief: _step_pb2.Belief
    problem: _problem_pb2.Problem
    def __init__(self, belief: _Optional[_Union[_step_pb2.Belief, _Mapping]] = ..., problem: _Optional[_Union[_problem_pb2.Problem, _Mapping]] = ...) -> None: ...

class ForkSessionRequest(_message.Message):
    __slots__ = ("session_id", "at_step", "count", "label", "seed")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    AT_STEP_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    at_step: int
    count: int
    label: str
    seed: int
    def __init__(self, session_id: _Optional[str] = ..., at_step: _Optional[int] = ..., count: _Optional[int] = ..., label: _Optional[str] = ..., seed: _Optional[int] = ...) -> None: ...

class ForkSessionResponse(_message.Message):
    __slots__ = ("sessions",)
    SESSIONS_FIELD_NUMBER: _ClassVar[int]
    sessions: _containers.RepeatedCompositeFieldContainer[Session]
    def __init__(self, sessions: _Optional[_Iterable[_Union[Session, _Mapping]]] = ...) -> None: ...

class RewindSessionRequest(_message.Message):
    __slots__ = ("session_id", "to_step")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    TO_STEP_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    to_step: int
    def __init__(self, session_id: _Optional[str] = ..., to_step: _Optional[int] = ...) -> None: ...

class RewindSessionResponse(_message.Message):
    __slots__ = ("session",)
    SESSION_FIELD_NUMBER: _ClassVar[int]
    session: Session
    def __init__(self, session: _Optional[_Union[Session, _Mapping]] = ...) -> None: ...

class ExportSessionRequest(_message.Message):
    __slots__ = ("session_id", "at_step")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    AT_STEP_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    at_step: int
    def __init__(self, session_id: _Optional[str] = ..., at_step: _Optional[int] = ...) -> None: ...

class ExportSessionResponse(_message.Message):
    __slots__ = ("session", "snapshot")
    SESSION_FIELD_NUMBER: _ClassVar[int]
    SNAPSHOT_FIELD_NUMBER: _ClassVar[int]
    session: Session
    snapshot: bytes
    def __init__(self, session: _Optional[_Union[Session, _Mapping]] = ..., snapshot: _Optional[bytes] = ...) -> None: ...

class ImportSessionRequest(_message.Message):
    __slots__ = ("snapshot", "session_id", "label", "seed", "ttl", "keep_steps", "keep_frames", "latest_wins")
    SNAPSHOT_FIELD_NUMBER: _ClassVar[int]
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    TTL_FIELD_NUMBER: _ClassVar[int]
    KEEP_STEPS_FIELD_NUMBER: _ClassVar[int]
    KEEP_FRAMES_FIELD_NUMBER: _ClassVar[int]
    LATEST_WINS_FIELD_NUMBER: _ClassVar[int]
    snapshot: bytes
    session_id: str
    label: str
    seed: int
    ttl: _duration_pb2.Duration
    keep_steps: int
    keep_frames: int
    latest_wins: bool
    def __init__(self, snapshot: _Optional[bytes] = ..., session_id: _Optional[str] = ..., label: _Optional[str] = ..., seed: _Optional[int] = ..., ttl: _Optional[_Union[datetime.timedelta, _duration_pb2.Duration, _Mapping]] = ..., keep_steps: _Optional[int] = ..., keep_frames: _Optional[int] = ..., latest_wins: bool = ...) -> None: ...

class ImportSessionResponse(_message.Message):
    __slots__ = ("session",)
    SESSION_FIELD_NUMBER: _ClassVar[int]
    session: Session
    def __init__(self, session: _Optional[_Union[Session, _Mapping]] = ...) -> None: ...
