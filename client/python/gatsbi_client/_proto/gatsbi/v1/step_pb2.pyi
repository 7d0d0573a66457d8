from gatsbi_client._proto.gatsbi.v1 import output_pb2 as _output_pb2
from gatsbi_client._proto.gatsbi.v1 import tensor_pb2 as _tensor_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Mode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    MODE_UNSPECIFIED: _ClassVar[Mode]
    MODE_MEAN: _ClassVar[Mode]
    MODE_SAMPLE: _ClassVar[Mode]
MODE_UNSPECIFIED: Mode
MODE_MEAN: Mode
MODE_SAMPLE: Mode

class Sampling(_message.Message):
    __slots__ = ("mode", "seed", "samples", "independent_candidates")
    MODE_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    SAMPLES_FIELD_NUMBER: _ClassVar[int]
    INDEPENDENT_CANDIDATES_FIELD_NUMBER: _ClassVar[int]
    mode: Mode
    seed: int
    samples: int
    independent_candidates: bool
    def __init__(self, mode: _Optional[_Union[Mode, str]] = ..., seed: _Optional[int] = ..., samples: _Optional[int] = ..., independent_candidates: bool = ...) -> None: ...

class Observation(_message.Message):
    __slots__ = ("step", "image", "action")
    STEP_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    ACTION_FIELD_NUMBER: _ClassVar[int]
    step: int
    image: _tensor_pb2.Image
    action: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, step: _Optional[int] = ..., image: _Optional[_Union[_tensor_pb2.Image, _Mapping]] = ..., action: _Optional[_Iterable[float]] = ...) -> None: ...

class Belief(_message.Message):
    __slots__ = ("session_id", "step", "model_hash", "predicted", "repeated", "outputs", "objects", "timing", "image_skipped")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    MODEL_HASH_FIELD_NUMBER: _ClassVar[int]
    PREDICTED_FIELD_NUMBER: _ClassVar[int]
    REPEATED_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    OBJECTS_FIELD_NUMBER: _ClassVar[int]
    TIMING_FIELD_NUMBER: _ClassVar[int]
    IMAGE_SKIPPED_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    step: int
    model_hash: str
    predicted: bool
    repeated: bool
    outputs: _containers.RepeatedCompositeFieldContainer[_output_pb2.OutputValue]
    objects: _containers.RepeatedCompositeFieldContainer[_output_pb2.Object]
    timing: Timing
    image_skipped: bool
    def __init__(self, session_id: _Optional[str] = ..., step: _Optional[int] = ..., model_hash: _Optional[str] = ..., predicted: bool = ..., repeated: bool = ..., outputs: _Optional[_Iterable[_Union[_output_pb2.OutputValue, _Mapping]]] = ..., objects: _Optional[_Iterable[_Union[_output_pb2.Object, _Mapping]]] = ..., timing: _Optional[_Union[Timing, _Mapping]] = ..., image_skipped: bool = ...) -> None: ...

class Timing(_message.Message):
    __slots__ = ("queue_micros", "compute_micros", "encode_micros")
    QUEUE_MICROS_FIELD_NUMBER: _ClassVar[int]
    COMPUTE_MICROS_FIELD_NUMBER: _ClassVar[int]
    ENCODE_MICROS_FIELD_NUMBER: _ClassVar[int]
    queue_micros: int
    compute_micros: int
    encode_micros: int
    def __init__(self, queue_micros: _Optional[int] = ..., compute_micros: _Optional[int] = ..., encode_micros: _Optional[int] = ...) -> None: ...
