import datetime

from gatsbi_client._proto.gatsbi.v1 import tensor_pb2 as _tensor_pb2
from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class MaskPart(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    MASK_PART_UNSPECIFIED: _ClassVar[MaskPart]
    MASK_PART_ALL_OBJECTS: _ClassVar[MaskPart]
    MASK_PART_EACH_OBJECT: _ClassVar[MaskPart]
    MASK_PART_AGENT: _ClassVar[MaskPart]
MASK_PART_UNSPECIFIED: MaskPart
MASK_PART_ALL_OBJECTS: MaskPart
MASK_PART_EACH_OBJECT: MaskPart
MASK_PART_AGENT: MaskPart

class MaskGoal(_message.Message):
    __slots__ = ("part", "masks", "object_ids")
    PART_FIELD_NUMBER: _ClassVar[int]
    MASKS_FIELD_NUMBER: _ClassVar[int]
    OBJECT_IDS_FIELD_NUMBER: _ClassVar[int]
    part: MaskPart
    masks: _tensor_pb2.Tensor
    object_ids: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, part: _Optional[_Union[MaskPart, str]] = ..., masks: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., object_ids: _Optional[_Iterable[int]] = ...) -> None: ...

class Goal(_message.Message):
    __slots__ = ("id", "label", "model", "has_image", "parts", "expires_at")
    ID_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    HAS_IMAGE_FIELD_NUMBER: _ClassVar[int]
    PARTS_FIELD_NUMBER: _ClassVar[int]
    EXPIRES_AT_FIELD_NUMBER: _ClassVar[int]
    id: str
    label: str
    model: str
    has_image: bool
    parts: _containers.RepeatedScalarFieldContainer[MaskPart]
    expires_at: _timestamp_pb2.Timestamp
    def __init__(self, id: _Optional[str] = ..., label: _Optional[str] = ..., model: _Optional[str] = ..., has_image: bool = ..., parts: _Optional[_Iterable[_Union[MaskPart, str]]] = ..., expires_at: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ...) -> None: ...
