from gatsbi_client._proto.gatsbi.v1 import model_service_pb2 as _model_service_pb2
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class SwapPolicy(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SWAP_POLICY_UNSPECIFIED: _ClassVar[SwapPolicy]
    SWAP_POLICY_REPLAY: _ClassVar[SwapPolicy]
    SWAP_POLICY_DRAIN: _ClassVar[SwapPolicy]
    SWAP_POLICY_CLOSE: _ClassVar[SwapPolicy]
SWAP_POLICY_UNSPECIFIED: SwapPolicy
SWAP_POLICY_REPLAY: SwapPolicy
SWAP_POLICY_DRAIN: SwapPolicy
SWAP_POLICY_CLOSE: SwapPolicy

class LoadModelRequest(_message.Message):
    __slots__ = ("path", "name")
    PATH_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    path: str
    name: str
    def __init__(self, path: _Optional[str] = ..., name: _Optional[str] = ...) -> None: ...

class LoadModelResponse(_message.Message):
    __slots__ = ("model",)
    MODEL_FIELD_NUMBER: _ClassVar[int]
    model: _model_service_pb2.Model
    def __init__(self, model: _Optional[_Union[_model_service_pb2.Model, _Mapping]] = ...) -> None: ...

class UnloadModelRequest(_message.Message):
    __slots__ = ("model", "close_sessions")
    MODEL_FIELD_NUMBER: _ClassVar[int]
    CLOSE_SESSIONS_FIELD_NUMBER: _ClassVar[int]
    model: str
    close_sessions: bool
    def __init__(self, model: _Optional[str] = ..., close_sessions: bool = ...) -> None: ...

class UnloadModelResponse(_message.Message):
    __slots__ = ("closed_sessions",)
    CLOSED_SESSIONS_FIELD_NUMBER: _ClassVar[int]
    closed_sessions: int
    def __init__(self, closed_sessions: _Optional[int] = ...) -> None: ...

class SwapModelRequest(_message.Message):
    __slots__ = ("model", "path", "policy")
    MODEL_FIELD_NUMBER: _ClassVar[int]
    PATH_FIELD_NUMBER: _ClassVar[int]
    POLICY_FIELD_NUMBER: _ClassVar[int]
    model: str
    path: str
    policy: SwapPolicy
    def __init__(self, model: _Optional[str] = ..., path: _Optional[str] = ..., policy: _Optional[_Union[SwapPolicy, str]] = ...) -> None: ...

class SwapModelResponse(_message.Message):
    __slots__ = ("model", "moved_sessions", "closed_sessions")
    MODEL_FIELD_NUMBER: _ClassVar[int]
    MOVED_SESSIONS_FIELD_NUMBER: _ClassVar[int]
    CLOSED_SESSIONS_FIELD_NUMBER: _ClassVar[int]
    model: _model_service_pb2.Model
    moved_sessions: int
    closed_sessions: int
    def __init__(self, model: _Optional[_Union[_model_service_pb2.Model, _Mapping]] = ..., moved_sessions: _Optional[int] = ..., closed_sessions: _Optional[int] = ...) -> None: ...
