"""Converts protobuf bytes to frozen dataclasses with numpy arrays, and back.

Dataclass and protobuf message have the same name and the same field names (a test compares them), so one pair of
functions per *kind of field*, ``put`` and ``get``, serves every message. ``decode`` refuses all that ``checks``
refuses, so no other code gets a wrong shape, a NaN or an oversized blob. ``encode`` applies the same checks.

Images are spliced: their bytes enter and leave the protobuf wire format by hand, with one copy instead of four. The
result is ordinary protobuf, which any other decoder can read.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache, lru_cache
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as Proto

from protocol import messages as m
from protocol import splice
from protocol.checks import MAX_IMAGES, MAX_MESSAGE_BYTES, MAX_PLAIN_MESSAGE_BYTES, MAX_TEXT, check
from protocol.errors import MalformedMessage, ProtocolError
from protocol.ponderpounce.v1 import common_pb2, episode_pb2, stream_pb2

T = TypeVar("T")

_PROTOS: dict[str, type[Proto]] = {
    name: getattr(module, name)
    for module in (common_pb2, stream_pb2, episode_pb2)
    for name in module.DESCRIPTOR.message_types_by_name
}
_DTYPES = {common_pb2.DTYPE_F32: np.dtype("<f4"), common_pb2.DTYPE_F16: np.dtype("<f2")}


_WORDS: dict[type, tuple[str, ...]] = {
    m.Event: ("text",),
    m.Health: ("detail",),
    m.EpisodeResult: ("reason",),
    m.CloseRequest: ("result",),
    m.OpenReply: ("error", "warnings"),
    **dict.fromkeys(
        (m.ContractReply, m.CloseReply, m.ActiveReply, m.JournalReply, m.TimeReply, m.EngageReply), ("error",)
    ),
}
"""Fields with words for people."""


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
    """Serializes one message. Words for people that are too long are cut: they may quote what anybody has sent.

    Raises:
        MalformedMessage: the message breaks a rule of ``checks``.
    """
    message = brief(message)
    check(message)
    if isinstance(message, m.Observation):
        small = _to_proto(message, but="images").SerializeToString()
        return splice.join(small, _OBSERVATION_IMAGES, _IMAGE_DATA, [(_meta(i), i.data) for i in message.images])
    return _to_proto(message).SerializeToString()


def decode(cls: type[T], payload: bytes) -> T:
    """Parses and checks one message.

    Raises:
        MalformedMessage: the bytes are no ``cls``, or the message breaks a rule of ``checks``.
    """
    most = MAX_MESSAGE_BYTES if cls in _WITH_PICTURES else MAX_PLAIN_MESSAGE_BYTES
    if len(payload) > most:
        raise MalformedMessage(cls.__name__, "*", f"at most {most} bytes", f"{len(payload)}")
    images: list[tuple[bytes, memoryview]] = []
    try:
        if cls is m.Observation:
            payload, images = splice.split(payload, _OBSERVATION_IMAGES, _IMAGE_DATA, most=MAX_IMAGES)
        fields = _from_fields(cls, proto_class(cls).FromString(payload))
        if images:  # those at the front; other encoders put none there
            fields["images"] = tuple(_image(meta, data) for meta, data in images) + fields["images"]
        message = cls(**fields)
    except (DecodeError, ValueError) as error:
        raise MalformedMessage(cls.__name__, "*", f"{type_name(cls)} bytes", f"{error}") from None
    check(message)
    return message


def brief(message: T) -> T:
    """The message with its words for people cut to what `check` allows; itself if they are that short."""
    cut = {name: _cut(getattr(message, name)) for name in _WORDS.get(type(message), ())}
    changed = {name: words for name, words in cut.items() if words is not getattr(message, name)}
    return dataclasses.replace(message, **changed) if changed else message  # type: ignore[type-var]


def _cut(words: Any) -> Any:
    if isinstance(words, str):
        return words if len(words) <= MAX_TEXT else f"{words[: MAX_TEXT // 2]} ... ({len(words)} characters)"
    if isinstance(words, tuple):
        return tuple(map(_cut, words)) if any(len(each) > MAX_TEXT for each in words) else words
    return brief(words)


def _meta(image: m.Image) -> bytes:
    return _meta_bytes(image.camera, image.codec, image.height, image.width, image.crc32)


@lru_cache(maxsize=64)  # a camera's pictures differ only in their pixels
def _meta_bytes(camera: str, codec: m.ImageCodec, height: int, width: int, crc32: int) -> bytes:
    return _to_proto(m.Image(camera=camera, codec=codec, height=height, width=width, crc32=crc32)).SerializeToString()


def _image(meta: bytes, data: memoryview) -> m.Image:
    known = _image_of(meta) if len(meta) <= _MAX_CACHED_BYTES else _image_of.__wrapped__(meta)
    return known if known.data else dataclasses.replace(known, data=data)  # proto3: the last of two values counts


@lru_cache(maxsize=64)
def _image_of(meta: bytes) -> m.Image:
    return _from_proto(m.Image, common_pb2.Image.FromString(meta))  # type: ignore[no-any-return]


def _to_proto(message: Any, *, but: str = "") -> Proto:
    """Converts all fields, or all but one."""
    try:
        return proto_class(type(message))(**_to_fields(message, but))
    except (TypeError, ValueError):
        raise _culprit(message) from None


def _culprit(message: Any) -> MalformedMessage:
    """The field that protobuf refuses, found by trying each alone."""
    plan = _plan(type(message))  # type: ignore[arg-type]
    for name in plan.names:
        value = getattr(message, name)
        for part in value if isinstance(value, tuple) else (value,):
            if dataclasses.is_dataclass(part):
                try:
                    _to_proto(part)
                except MalformedMessage as error:
                    return error
        try:
            put = plan.put.get(name)
            proto_class(type(message))(**{name: put(value) if put else value})
        except (TypeError, ValueError):
            return MalformedMessage(type(message).__name__, name, "a value of its type", f"{value!r:.60}")
    return MalformedMessage(type(message).__name__, "*", "values of their types", f"{message!r:.60}")


def _to_fields(message: Any, but: str = "") -> dict[str, Any]:
    """Arguments of the generated class's constructor: one call into C instead of one per field."""
    plan = _plan(type(message))  # type: ignore[arg-type]
    fields = dict(zip(plan.names, plan.read(message), strict=True))
    fields.pop(but, None)
    for name, put in plan.put.items():
        if name != but:
            fields[name] = put(fields[name])
    return fields


def _from_proto(cls: type, proto: Proto) -> Any:
    return cls(**_from_fields(cls, proto))


def _from_fields(cls: type, proto: Proto) -> dict[str, Any]:
    plan = _plan(cls)
    fields = dict(zip(plan.names, plan.read(proto), strict=True))
    name = ""
    try:
        for name, get in plan.get.items():
            fields[name] = get(proto, fields[name])
    except (KeyError, ValueError) as error:
        raise MalformedMessage(cls.__name__, name, "a value of its type", f"{error}") from None
    return fields


_Put = Callable[[Any], Any]  # dataclass value -> constructor argument
_Get = Callable[[Proto, Any], Any]  # message and attribute -> dataclass value


class _Plan(NamedTuple):
    """Conversion of one message type: all of its fields, and those that differ between the two sides."""

    names: tuple[str, ...]
    read: Callable[[Any], tuple[Any, ...]]
    put: dict[str, _Put]
    get: dict[str, _Get]


@cache
def _plan(cls: Any) -> _Plan:
    descriptor = proto_class(cls).DESCRIPTOR
    defaults = {f.name: f.default for f in dataclasses.fields(cls)}
    if set(defaults) != set(descriptor.fields_by_name):
        odd = set(defaults) ^ set(descriptor.fields_by_name)
        raise ProtocolError(f"{cls.__name__} and {descriptor.full_name} differ in {sorted(odd)}")
    names = tuple(defaults)
    kinds = {n: _kind(descriptor.fields_by_name[n], default) for n, default in defaults.items()}
    return _Plan(
        names=names,
        read=attrgetter(*names) if len(names) > 1 else lambda source: (getattr(source, names[0]),),
        put={n: put for n, (put, _) in kinds.items() if put is not None},
        get={n: get for n, (_, get) in kinds.items() if get is not None},
    )


def _kind(field: Any, default: Any) -> tuple[_Put | None, _Get | None]:
    is_message = field.type == FieldDescriptor.TYPE_MESSAGE
    name = field.name
    if is_message and field.message_type.GetOptions().map_entry:
        return None, lambda proto, value: dict(value)
    if is_message and field.message_type.name == "Tensor":
        return _put_tensor, lambda proto, value: _get_tensor(value)
    if is_message:
        cls = getattr(m, field.message_type.name)
        if field.is_repeated:
            return _put_messages, lambda proto, value: tuple(_from_proto(cls, p) for p in value)
        return _put_message, lambda proto, value: _get_message(cls, default, proto.HasField(name), value)
    if field.is_repeated:
        is_floats = field.type == FieldDescriptor.TYPE_FLOAT
        return (_put_floats, lambda proto, value: _get_floats(value)) if is_floats else (None, _get_scalars)
    if field.type == FieldDescriptor.TYPE_ENUM:
        cls = getattr(m, field.enum_type.name)
        members = {int(member): member for member in cls}
        return None, lambda proto, value: members[value] if value in members else _unknown(cls, value)
    if field.has_presence:
        return None, lambda proto, value: value if proto.HasField(name) else None
    return (bytes, None) if field.type == FieldDescriptor.TYPE_BYTES else (None, None)


def _unknown(cls: Any, value: int) -> Any:
    """What a newer peer's value, or a reserved one, counts as."""
    try:
        return cls(value)
    except ValueError:
        return cls.UNSPECIFIED


def _get_scalars(proto: Proto, value: Any) -> tuple[Any, ...]:
    return tuple(value)


def _put_floats(value: Any) -> Any:
    return np.asarray(value, np.float32).ravel().tolist()


def _get_floats(repeated: Any) -> m.Floats:
    if not repeated:
        return _NO_FLOATS
    values = np.array(repeated, np.float32)
    values.flags.writeable = False
    return values


def _put_tensor(value: Any) -> dict[str, Any]:
    array = np.ascontiguousarray(value, "<f4")
    return {"dtype": common_pb2.DTYPE_F32, "shape": array.shape, "data": array.tobytes()}


def _get_tensor(tensor: Any) -> m.Floats:
    """Converts to float32; bf16 and f16 widen exactly."""
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


def _put_message(value: Any) -> dict[str, Any] | None:
    return None if value is None else _to_fields(value)


def _get_message(cls: type, default: Any, is_there: bool, proto: Proto) -> Any:
    if is_there:
        return _from_proto(cls, proto)
    if default is dataclasses.MISSING:
        raise ValueError("nothing")
    return default


def _put_messages(value: Any) -> list[dict[str, Any]]:
    return [_to_fields(item) for item in value]


_NO_FLOATS = np.zeros(0, np.float32)
_NO_FLOATS.flags.writeable = False
_MAX_CACHED_BYTES = 512  # so that an untrusted peer cannot fill a cache with large keys
_WITH_PICTURES = (m.Observation, m.OpenRequest, m.ActiveReply, m.JournalReply)
_OBSERVATION_IMAGES = stream_pb2.Observation.DESCRIPTOR.fields_by_name["images"].number
_IMAGE_DATA = common_pb2.Image.DESCRIPTOR.fields_by_name["data"].number
