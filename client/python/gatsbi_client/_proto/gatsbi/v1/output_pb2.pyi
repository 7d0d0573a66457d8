from gatsbi_client._proto.gatsbi.v1 import tensor_pb2 as _tensor_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Output(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    OUTPUT_UNSPECIFIED: _ClassVar[Output]
    OUTPUT_FRAME: _ClassVar[Output]
    OUTPUT_AGENT_MASK: _ClassVar[Output]
    OUTPUT_SLOT_MASKS: _ClassVar[Output]
    OUTPUT_OBJECT_MASKS: _ClassVar[Output]
    OUTPUT_BACKGROUND: _ClassVar[Output]
    OUTPUT_OBJECTS: _ClassVar[Output]
    OUTPUT_LATENTS: _ClassVar[Output]
    OUTPUT_SURPRISE: _ClassVar[Output]
    OUTPUT_LOG_LIKELIHOOD: _ClassVar[Output]
    OUTPUT_KEYPOINTS: _ClassVar[Output]
    OUTPUT_SPREAD: _ClassVar[Output]
    OUTPUT_OBJECT_SPREAD: _ClassVar[Output]
    OUTPUT_COSTS: _ClassVar[Output]

class Encoding(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ENCODING_UNSPECIFIED: _ClassVar[Encoding]
    ENCODING_F32: _ClassVar[Encoding]
    ENCODING_F16: _ClassVar[Encoding]
    ENCODING_U8: _ClassVar[Encoding]
    ENCODING_PNG: _ClassVar[Encoding]
OUTPUT_UNSPECIFIED: Output
OUTPUT_FRAME: Output
OUTPUT_AGENT_MASK: Output
OUTPUT_SLOT_MASKS: Output
OUTPUT_OBJECT_MASKS: Output
OUTPUT_BACKGROUND: Output
OUTPUT_OBJECTS: Output
OUTPUT_LATENTS: Output
OUTPUT_SURPRISE: Output
OUTPUT_LOG_LIKELIHOOD: Output
OUTPUT_KEYPOINTS: Output
OUTPUT_SPREAD: Output
OUTPUT_OBJECT_SPREAD: Output
OUTPUT_COSTS: Output
ENCODING_UNSPECIFIED: Encoding
ENCODING_F32: Encoding
ENCODING_F16: Encoding
ENCODING_U8: Encoding
ENCODING_PNG: Encoding

class OutputSelection(_message.Message):
    __slots__ = ("outputs", "encoding", "every_k", "last_only")
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    EVERY_K_FIELD_NUMBER: _ClassVar[int]
    LAST_ONLY_FIELD_NUMBER: _ClassVar[int]
    outputs: _containers.RepeatedScalarFieldContainer[Output]
    encoding: Encoding
    every_k: int
    last_only: bool
    def __init__(self, outputs: _Optional[_Iterable[_Union[Output, str]]] = ..., encoding: _Optional[_Union[Encoding, str]] = ..., every_k: _Optional[int] = ..., last_only: bool = ...) -> None: ...

class OutputValue(_message.Message):
    __slots__ = ("output", "tensor", "images", "tracks")
    OUTPUT_FIELD_NUMBER: _ClassVar[int]
    TENSOR_FIELD_NUMBER: _ClassVar[int]
    IMAGES_FIELD_NUMBER: _ClassVar[int]
    TRACKS_FIELD_NUMBER: _ClassVar[int]
    output: Output
    tensor: _tensor_pb2.Tensor
    images: Images
    tracks: ObjectTracks
    def __init__(self, output: _Optional[_Union[Output, str]] = ..., tensor: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., images: _Optional[_Union[Images, _Mapping]] = ..., tracks: _Optional[_Union[ObjectTracks, _Mapping]] = ...) -> None: ...

class Images(_message.Message):
    __slots__ = ("shape", "png")
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    PNG_FIELD_NUMBER: _ClassVar[int]
    shape: _containers.RepeatedScalarFieldContainer[int]
    png: _containers.RepeatedScalarFieldContainer[bytes]
    def __init__(self, shape: _Optional[_Iterable[int]] = ..., png: _Optional[_Iterable[bytes]] = ...) -> None: ...

class ObjectTracks(_message.Message):
    __slots__ = ("ids", "values")
    IDS_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    ids: _tensor_pb2.Tensor
    values: _tensor_pb2.Tensor
    def __init__(self, ids: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., values: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ...) -> None: ...

class Object(_message.Message):
    __slots__ = ("id", "slot", "presence", "x", "y", "width", "height", "depth", "pixel_x", "pixel_y")
    ID_FIELD_NUMBER: _ClassVar[int]
    SLOT_FIELD_NUMBER: _ClassVar[int]
    PRESENCE_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    PIXEL_X_FIELD_NUMBER: _ClassVar[int]
    PIXEL_Y_FIELD_NUMBER: _ClassVar[int]
    id: int
    slot: int
    presence: float
    x: float
    y: float
    width: float
    height: float
    depth: float
    pixel_x: float
    pixel_y: float
    def __init__(self, id: _Optional[int] = ..., slot: _Optional[int] = ..., presence: _Optional[float] = ..., x: _Optional[float] = ..., y: _Optional[float] = ..., width: _Optional[float] = ..., height: _Optional[float] = ..., depth: _Optional[float] = ..., pixel_x: _Optional[float] = ..., pixel_y: _Optional[float] = ...) -> None: ...
