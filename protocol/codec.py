"""The border: protobuf bytes to frozen dataclasses with numpy arrays, and back.

Dataclass and protobuf message have the same name and the same field names (a test holds them together), so one pair of
functions per *kind of field* serves every message; ``to`` and ``from`` stand side by side. ``decode`` refuses whatever
``checks`` refuses, so nothing behind the border ever sees a wrong shape, a NaN or an oversized blob. ``encode`` applies
the same checks: we do not send what a peer must drop.

Images are spliced: their bytes enter and leave the protobuf wire format by hand, as one copy instead of four. The
bytes are ordinary protobuf; any other decoder reads them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from enum import IntEnum
from functools import cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as Proto

from protocol import messages as m
from protocol import splice
from protocol.checks import MAX_MESSAGE_BYTES, check
from protocol.errors import MalformedMessage, ProtocolError
from protocol.ponderpounce.v1 import common_pb2, episode_pb2, stream_pb2

T = TypeVar("T")

_PROTOS: dict[str, type[Proto]] = {
    name: getattr(module, name)
    for module in (common_pb2, stream_pb2, episode_pb2)
    for name in module.DESCRIPTOR.message_types_by_name
}
_DTYPES = {common_pb2.DTYPE_F32: np.dtype("<f4"), common_pb2.DTYPE_F16: np.dtype("<f2")}


def proto_class(cls: type) -> type[Proto]:
    """The generated class of the same name.

    Raises:
        ProtocolError: ``cls`` is not a message of this protocol.
    """
    found = _PROTOS.get(cls.__name__)
    if found is None:
        raise ProtocolError(f"{cls.__name__} is not a message of ponderpounce.v1")
    return found


def type_name(cls: type) -> str:
    """Full protobuf name, as in MCAP schemas and zenoh encodings: ``ponderpounce.v1.Tick``."""
    return str(proto_class(cls).DESCRIPTOR.full_name)


def encode(message: Any) -> bytes:
    """Serializes one message.

    Raises:
        MalformedMessage: the message breaks a rule of ``checks``.
    """
    check(message)
    if isinstance(message, m.Observation):
        small = _to_proto(message, but="images").SerializeToString()
        blobs = [(_to_proto(image, but="data").SerializeToString(), image.data) for image in message.images]
        return splice.join(small, _OBSERVATION_IMAGES, _IMAGE_DATA, blobs)
    return _to_proto(message).SerializeToString()


def decode(cls: type[T], payload: bytes) -> T:
    """Parses and checks one message.

    Raises:
        MalformedMessage: not the bytes of a ``cls``, or a rule of ``checks`` is broken.
    """
    if len(payload) > MAX_MESSAGE_BYTES:
        raise MalformedMessage(cls.__name__, "*", f"at most {MAX_MESSAGE_BYTES} bytes", f"{len(payload)}")
    proto = proto_class(cls)()
    images: list[tuple[bytes, memoryview]] = []
    try:
        if cls is m.Observation:
            payload, images = splice.split(payload, _OBSERVATION_IMAGES, _IMAGE_DATA)
        proto.ParseFromString(payload)
    except (DecodeError, ValueError) as error:
        raise MalformedMessage(cls.__name__, "*", f"{type_name(cls)} bytes", f"{error}") from None
    message = _from_proto(cls, proto, **({"images": tuple(_image(*i) for i in images)} if images else {}))
    check(message)
    return message  # type: ignore[no-any-return]


def _image(meta: bytes, data: memoryview) -> m.Image:
    proto = common_pb2.Image()
    try:
        proto.ParseFromString(meta)
    except DecodeError as error:
        raise MalformedMessage("Image", "*", "ponderpounce.v1.Image bytes", f"{error}") from None
    return _from_proto(m.Image, proto, data=data)  # type: ignore[no-any-return]


class _Field(NamedTuple):
    """One field, and how its value gets into (``put``) and out of (``get``) the protobuf message."""

    name: str
    put: Callable[[Proto, str, Any], None]
    get: Callable[[Proto, str], Any]


def _to_proto(message: Any, *, but: str = "") -> Proto:
    """All fields, or all but one."""
    proto = proto_class(type(message))()
    _fill(proto, message, but)
    return proto


def _fill(proto: Proto, message: Any, but: str = "") -> None:
    name = ""
    try:
        for name, put, _ in _fields(type(message)):  # type: ignore[arg-type]
            if name != but:
                put(proto, name, getattr(message, name))
    except (TypeError, ValueError) as error:
        came = f"{getattr(message, name)!r:.60}"
        raise MalformedMessage(type(message).__name__, name, "a value of its type", came) from error


def _from_proto(cls: type, proto: Proto, **values: Any) -> Any:
    """``values``: fields that are known already."""
    name = ""
    try:
        for name, _, get in _fields(cls):
            if name not in values:
                values[name] = get(proto, name)
    except ValueError as error:
        raise MalformedMessage(cls.__name__, name, "a value of its type", f"{error}") from None
    return cls(**values)


@cache
def _fields(cls: Any) -> tuple[_Field, ...]:
    descriptor = proto_class(cls).DESCRIPTOR
    defaults = {f.name: f.default for f in dataclasses.fields(cls)}
    if set(defaults) != set(descriptor.fields_by_name):
        odd = set(defaults) ^ set(descriptor.fields_by_name)
        raise ProtocolError(f"{cls.__name__} and {descriptor.full_name} differ in {sorted(odd)}")
    return tuple(_Field(n, *_kind(descriptor.fields_by_name[n], default)) for n, default in defaults.items())


_Pair = tuple[Callable[[Proto, str, Any], None], Callable[[Proto, str], Any]]


def _kind(field: Any, default: Any) -> _Pair:
    is_message = field.type == FieldDescriptor.TYPE_MESSAGE
    if is_message and field.message_type.GetOptions().map_entry:
        return _put_map, _get_map
    if is_message and field.message_type.name == "Tensor":
        return _put_tensor, _get_tensor
    if is_message:
        cls = getattr(m, field.message_type.name)
        if field.is_repeated:
            return _put_messages, lambda proto, name: tuple(_from_proto(cls, p) for p in getattr(proto, name))
        return _put_message, lambda proto, name: _get_message(cls, default, proto, name)
    if field.is_repeated:
        return (_put_floats, _get_floats) if field.type == FieldDescriptor.TYPE_FLOAT else (_put_scalars, _get_scalars)
    if field.type == FieldDescriptor.TYPE_ENUM:
        enum: type[IntEnum] = getattr(m, field.enum_type.name)
        return setattr, lambda proto, name: enum(getattr(proto, name))
    if field.has_presence:
        return _put_optional, lambda proto, name: getattr(proto, name) if _has(proto, name) else None
    return (_put_bytes if field.type == FieldDescriptor.TYPE_BYTES else setattr), getattr


def _has(proto: Proto, name: str) -> bool:
    return bool(proto.HasField(name))


def _put_optional(proto: Proto, name: str, value: Any) -> None:
    if value is not None:
        setattr(proto, name, value)


def _put_bytes(proto: Proto, name: str, value: bytes | memoryview) -> None:
    setattr(proto, name, bytes(value))


def _put_scalars(proto: Proto, name: str, value: Any) -> None:
    getattr(proto, name).extend(value)


def _get_scalars(proto: Proto, name: str) -> tuple[Any, ...]:
    return tuple(getattr(proto, name))


def _put_floats(proto: Proto, name: str, value: Any) -> None:
    getattr(proto, name).extend(np.asarray(value, np.float32).ravel().tolist())


def _get_floats(proto: Proto, name: str) -> m.Floats:
    values = np.array(getattr(proto, name), np.float32)
    values.flags.writeable = False
    return values


def _put_tensor(proto: Proto, name: str, value: Any) -> None:
    array = np.ascontiguousarray(value, "<f4")
    tensor = getattr(proto, name)
    tensor.dtype = common_pb2.DTYPE_F32
    tensor.shape.extend(array.shape)
    tensor.data = array.tobytes()


def _get_tensor(proto: Proto, name: str) -> m.Floats:
    """float32, whatever dtype travelled: bf16 and f16 widen exactly."""
    tensor = getattr(proto, name)
    shape, data = tuple(tensor.shape), tensor.data
    if not data and 0 in (shape or (0,)):
        return np.zeros((0, 0), np.float32)
    if tensor.dtype == common_pb2.DTYPE_BF16:
        halves = np.frombuffer(data, "<u2") if len(data) % 2 == 0 else np.zeros(0, "<u2")
        flat = (halves.astype(np.uint32) << 16).view(np.float32)
    elif tensor.dtype in _DTYPES:
        dtype: Any = _DTYPES[tensor.dtype]
        flat = np.frombuffer(data, dtype).astype(np.float32, copy=False)  # ValueError if the length is off
    else:
        raise ValueError(f"dtype {tensor.dtype}")
    if len(shape) > 4 or int(np.prod([int(s) for s in shape], dtype=object)) != flat.size:
        raise ValueError(f"shape {shape} for {flat.size} numbers")
    return flat.reshape(shape)


def _put_message(proto: Proto, name: str, value: Any) -> None:
    if value is not None:
        sub = getattr(proto, name)
        sub.SetInParent()
        _fill(sub, value)


def _get_message(cls: type, default: Any, proto: Proto, name: str) -> Any:
    if _has(proto, name):
        return _from_proto(cls, getattr(proto, name))
    if default is dataclasses.MISSING:
        raise ValueError("nothing")
    return default


def _put_messages(proto: Proto, name: str, value: Any) -> None:
    for item in value:
        _fill(getattr(proto, name).add(), item)


def _put_map(proto: Proto, name: str, value: Any) -> None:
    getattr(proto, name).update(value)


def _get_map(proto: Proto, name: str) -> dict[str, Any]:
    return dict(getattr(proto, name))


_OBSERVATION_IMAGES = stream_pb2.Observation.DESCRIPTOR.fields_by_name["images"].number
_IMAGE_DATA = common_pb2.Image.DESCRIPTOR.fields_by_name["data"].number
