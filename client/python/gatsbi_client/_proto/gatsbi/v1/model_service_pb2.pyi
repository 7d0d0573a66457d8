from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Preprocess(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    PREPROCESS_UNSPECIFIED: _ClassVar[Preprocess]
    PREPROCESS_STRETCH: _ClassVar[Preprocess]
    PREPROCESS_CENTRE_CROP: _ClassVar[Preprocess]
PREPROCESS_UNSPECIFIED: Preprocess
PREPROCESS_STRETCH: Preprocess
PREPROCESS_CENTRE_CROP: Preprocess

class ListModelsRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ListModelsResponse(_message.Message):
    __slots__ = ("models",)
    MODELS_FIELD_NUMBER: _ClassVar[int]
    models: _containers.RepeatedCompositeFieldContainer[Model]
    def __init__(self, models: _Optional[_Iterable[_Union[Model, _Mapping]]] = ...) -> None: ...

class GetModelRequest(_message.Message):
    __slots__ = ("model",)
    MODEL_FIELD_NUMBER: _ClassVar[int]
    model: str
    def __init__(self, model: _Optional[str] = ...) -> None: ...

class GetModelResponse(_message.Message):
    __slots__ = ("model",)
    MODEL_FIELD_NUMBER: _ClassVar[int]
    model: Model
    def __init__(self, model: _Optional[_Union[Model, _Mapping]] = ...) -> None: ...

class Model(_message.Message):
    __slots__ = ("name", "hash", "image_size", "preprocess", "frame_period_seconds", "actions", "slots", "agent_slot", "max_objects", "keypoints", "latents", "trained_steps", "provenance", "card", "state_bytes", "device", "limits")
    NAME_FIELD_NUMBER: _ClassVar[int]
    HASH_FIELD_NUMBER: _ClassVar[int]
    IMAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PREPROCESS_FIELD_NUMBER: _ClassVar[int]
    FRAME_PERIOD_SECONDS_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    SLOTS_FIELD_NUMBER: _ClassVar[int]
    AGENT_SLOT_FIELD_NUMBER: _ClassVar[int]
    MAX_OBJECTS_FIELD_NUMBER: _ClassVar[int]
    KEYPOINTS_FIELD_NUMBER: _ClassVar[int]
    LATENTS_FIELD_NUMBER: _ClassVar[int]
    TRAINED_STEPS_FIELD_NUMBER: _ClassVar[int]
    PROVENANCE_FIELD_NUMBER: _ClassVar[int]
    CARD_FIELD_NUMBER: _ClassVar[int]
    STATE_BYTES_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    LIMITS_FIELD_NUMBER: _ClassVar[int]
    name: str
    hash: str
    image_size: int
    preprocess: Preprocess
    frame_period_seconds: float
    actions: _containers.RepeatedCompositeFieldContainer[ActionDimension]
    slots: int
    agent_slot: int
    max_objects: int
    keypoints: int
    latents: int
    trained_steps: int
    provenance: str
    card: str
    state_bytes: int
    device: str
    limits: Limits
    def __init__(self, name: _Optional[str] = ..., hash: _Optional[str] = ..., image_size: _Optional[int] = ..., preprocess: _Optional[_Union[Preprocess, str]] = ..., frame_period_seconds: _Optional[float] = ..., actions: _Optional[_Iterable[_Union[ActionDimension, _Mapping]]] = ..., slots: _Optional[int] = ..., agent_slot: _Optional[int] = ..., max_objects: _Optional[int] = ..., keypoints: _Optional[int] = ..., latents: _Optional[int] = ..., trained_steps: _Optional[int] = ..., provenance: _Optional[str] = ..., card: _Optional[str] = ..., state_bytes: _Optional[int] = ..., device: _Optional[str] = ..., limits: _Optional[_Union[Limits, _Mapping]] = ...) -> None: ...

class ActionDimension(_message.Message):
    __slots__ = ("name", "unit", "offset", "scale")
    NAME_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    SCALE_FIELD_NUMBER: _ClassVar[int]
    name: str
    unit: str
    offset: float
    scale: float
    def __init__(self, name: _Optional[str] = ..., unit: _Optional[str] = ..., offset: _Optional[float] = ..., scale: _Optional[float] = ...) -> None: ...

class Limits(_message.Message):
    __slots__ = ("max_candidates", "max_horizon", "max_samples", "max_rows", "max_output_bytes", "max_image_side", "max_request_bytes")
    MAX_CANDIDATES_FIELD_NUMBER: _ClassVar[int]
    MAX_HORIZON_FIELD_NUMBER: _ClassVar[int]
    MAX_SAMPLES_FIELD_NUMBER: _ClassVar[int]
    MAX_ROWS_FIELD_NUMBER: _ClassVar[int]
    MAX_OUTPUT_BYTES_FIELD_NUMBER: _ClassVar[int]
    MAX_IMAGE_SIDE_FIELD_NUMBER: _ClassVar[int]
    MAX_REQUEST_BYTES_FIELD_NUMBER: _ClassVar[int]
    max_candidates: int
    max_horizon: int
    max_samples: int
    max_rows: int
    max_output_bytes: int
    max_image_side: int
    max_request_bytes: int
    def __init__(self, max_candidates: _Optional[int] = ..., max_horizon: _Optional[int] = ..., max_samples: _Optional[int] = ..., max_rows: _Optional[int] = ..., max_output_bytes: _Optional[int] = ..., max_image_side: _Optional[int] = ..., max_request_bytes: _Optional[int] = ...) -> None: ...
