from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class DType(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DTYPE_UNSPECIFIED: _ClassVar[DType]
    DTYPE_F32: _ClassVar[DType]
    DTYPE_BF16: _ClassVar[DType]
    DTYPE_F16: _ClassVar[DType]

class ImageCodec(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    IMAGE_CODEC_UNSPECIFIED: _ClassVar[ImageCodec]
    IMAGE_CODEC_RAW: _ClassVar[ImageCodec]
    IMAGE_CODEC_JPEG: _ClassVar[ImageCodec]
    IMAGE_CODEC_PNG: _ClassVar[ImageCodec]
    IMAGE_CODEC_ELSEWHERE: _ClassVar[ImageCodec]

class TaskStatus(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TASK_STATUS_UNSPECIFIED: _ClassVar[TaskStatus]
    TASK_STATUS_ONGOING: _ClassVar[TaskStatus]
    TASK_STATUS_SUCCESS: _ClassVar[TaskStatus]
    TASK_STATUS_FAIL: _ClassVar[TaskStatus]
    TASK_STATUS_TIMEOUT: _ClassVar[TaskStatus]
    TASK_STATUS_ABORTED: _ClassVar[TaskStatus]
DTYPE_UNSPECIFIED: DType
DTYPE_F32: DType
DTYPE_BF16: DType
DTYPE_F16: DType
IMAGE_CODEC_UNSPECIFIED: ImageCodec
IMAGE_CODEC_RAW: ImageCodec
IMAGE_CODEC_JPEG: ImageCodec
IMAGE_CODEC_PNG: ImageCodec
IMAGE_CODEC_ELSEWHERE: ImageCodec
TASK_STATUS_UNSPECIFIED: TaskStatus
TASK_STATUS_ONGOING: TaskStatus
TASK_STATUS_SUCCESS: TaskStatus
TASK_STATUS_FAIL: TaskStatus
TASK_STATUS_TIMEOUT: TaskStatus
TASK_STATUS_ABORTED: TaskStatus

class Header(_message.Message):
    __slots__ = ("robot", "session", "episode", "epoch", "proc", "boot_id", "seq", "clock_id", "at_ns")
    ROBOT_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    PROC_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    CLOCK_ID_FIELD_NUMBER: _ClassVar[int]
    AT_NS_FIELD_NUMBER: _ClassVar[int]
    robot: str
    session: str
    episode: str
    epoch: int
    proc: str
    boot_id: int
    seq: int
    clock_id: str
    at_ns: int
    def __init__(self, robot: _Optional[str] = ..., session: _Optional[str] = ..., episode: _Optional[str] = ..., epoch: _Optional[int] = ..., proc: _Optional[str] = ..., boot_id: _Optional[int] = ..., seq: _Optional[int] = ..., clock_id: _Optional[str] = ..., at_ns: _Optional[int] = ...) -> None: ...

class Tensor(_message.Message):
    __slots__ = ("dtype", "shape", "data")
    DTYPE_FIELD_NUMBER: _ClassVar[int]
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    dtype: DType
    shape: _containers.RepeatedScalarFieldContainer[int]
    data: bytes
    def __init__(self, dtype: _Optional[_Union[DType, str]] = ..., shape: _Optional[_Iterable[int]] = ..., data: _Optional[bytes] = ...) -> None: ...

class Image(_message.Message):
    __slots__ = ("camera", "codec", "height", "width", "crc32", "data")
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    CODEC_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    CRC32_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    camera: str
    codec: ImageCodec
    height: int
    width: int
    crc32: int
    data: bytes
    def __init__(self, camera: _Optional[str] = ..., codec: _Optional[_Union[ImageCodec, str]] = ..., height: _Optional[int] = ..., width: _Optional[int] = ..., crc32: _Optional[int] = ..., data: _Optional[bytes] = ...) -> None: ...
