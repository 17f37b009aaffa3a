"""msgpack with numpy arrays, read as a stranger's bytes: no pickle, no objects, no size that the bytes do not have.

Two spellings of an array are in use: openpi's, with keys of bytes, and vla-eval's, with keys of text; the latter also
sends pictures as PNG or JPEG. Both are read, whichever comes.
"""

from __future__ import annotations

import math
import re
from typing import Any, Literal

import msgpack
import numpy as np

from sim_client.gateway.exchange import Refused
from sim_client.gateway.pictures import EncodedPicture

Spelling = Literal["openpi", "vla-eval"]

MAX_DIMENSIONS = 8
_DTYPE = re.compile(r"[<>|=]?(?:[iu][1248]|f[248]|b1)")
"""Numbers and truth values. A dtype is only made of a text that matches: others can mean objects or structures."""
_TEXT_DTYPE = re.compile(r"[<>=]?U[1-9][0-9]{0,3}")
"""Texts of up to so many characters, as numpy holds them: some clients send the prompt in an array."""
_MAX_ITEMS = 1_000_000


def pack(value: Any, spelling: Spelling) -> bytes:
    """Packs plain values and numeric arrays as that dialect's clients read them."""
    key: Any = str.encode if spelling == "openpi" else str

    def spell(item: Any) -> Any:
        if isinstance(item, np.generic):
            return item.item()
        if isinstance(item, np.ndarray) and _DTYPE.fullmatch(item.dtype.str):
            fields = {"__ndarray__": True, "data": item.tobytes(), "dtype": item.dtype.str, "shape": list(item.shape)}
            return {key(name): content for name, content in fields.items()}
        raise TypeError(f"{type(item).__name__} has no place in a message")

    return bytes(msgpack.packb(value, default=spell))


def unpack(data: bytes) -> Any:
    """The value in ``data``; arrays are read-only views, arrays of texts are texts in lists.

    Raises:
        Refused: not msgpack, an array whose shape, type and bytes disagree, or a structure beyond any real message's.
    """
    left = _MAX_ITEMS

    def counted(item: Any) -> Any:
        nonlocal left
        left -= 1 + len(item)
        if left < 0:  # each limit below is of one list: nested ones would multiply
            raise Refused(f"{len(data)} bytes that hold more than {_MAX_ITEMS} values: send arrays, not lists")
        return item

    try:
        return msgpack.unpackb(
            data,
            object_hook=lambda item: _unspell(counted(item)),
            list_hook=counted,
            max_map_len=10_000,
            max_array_len=_MAX_ITEMS,
            max_ext_len=0,
        )
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as error:
        raise Refused(f"{len(data)} bytes that are not a msgpack message: {error or type(error).__name__}") from None


def _unspell(item: dict[Any, Any]) -> Any:
    for key in (str, str.encode):
        if key("__ndarray__") in item:
            return _array(*(item.get(key(name)) for name in ("data", "dtype", "shape")))
        if key("__npgeneric__") in item:
            return item.get(key("data"))
    if "__image__" in item:
        return _picture(item)
    return item


def _picture(item: dict[Any, Any]) -> Any:
    kind, data, shape = item.get("format"), item.get("data"), item.get("shape")
    if kind == "raw":
        return _array(data, item.get("dtype"), shape)
    if kind not in ("png", "jpeg") or not isinstance(data, bytes):
        raise Refused(f"a picture in format {kind!r}: expected raw, png or jpeg, and its bytes")
    return EncodedPicture(kind, data, _shape(shape))


def _array(data: Any, dtype: Any, shape: Any) -> Any:
    is_text = isinstance(dtype, str) and _TEXT_DTYPE.fullmatch(dtype) is not None
    if not isinstance(data, bytes) or not isinstance(dtype, str) or not (is_text or _DTYPE.fullmatch(dtype)):
        raise Refused(f"an array of type {dtype!r}: expected the bytes of numbers, truth values or texts")
    sides, kind = _shape(shape), np.dtype(dtype)
    if math.prod(sides) * kind.itemsize != len(data):
        raise Refused(
            f"an array {sides} of {dtype}: expected {math.prod(sides) * kind.itemsize} bytes, {len(data)} came"
        )
    array = np.frombuffer(data, kind).reshape(sides)
    if not is_text:
        return array
    try:  # numpy does not check that they are characters
        data.decode("utf-32-be" if dtype.startswith(">") else "utf-32-le")
    except UnicodeDecodeError as error:
        raise Refused(f"an array of type {dtype!r}: expected texts, came other bytes: {error.reason}") from None
    return array.tolist()


def _shape(shape: Any) -> tuple[int, ...]:
    is_shape = isinstance(shape, list | tuple) and len(shape) <= MAX_DIMENSIONS
    if not is_shape or not all(type(side) is int and side >= 0 for side in shape):
        raise Refused(f"an array of shape {shape!r}: expected at most {MAX_DIMENSIONS} sizes")
    return tuple(shape)
