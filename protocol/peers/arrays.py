"""msgpack with numpy arrays, read as a stranger's bytes: no pickle, no objects, no size that the bytes do not have.

Four spellings of an array are in use. All are read, whichever comes; `pack` writes the one that a peer reads.
"""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Callable
from typing import Any, Literal

import msgpack
import numpy as np
from numpy.typing import NDArray

from protocol.errors import ProtocolError

Spelling = Literal["openpi", "vla-eval", "groot", "msgpack-numpy"]
"""openpi: keys of bytes. vla-eval: keys of text; it also sends pictures as PNG or JPEG. groot: an ``.npy`` file, of
GR00T N1.5 and N1.6. msgpack-numpy: that library's, of the newest GR00T N1.7."""

MAX_DIMENSIONS = 8
_DTYPE = re.compile(r"[<>|=]?(?:[iu][1248]|f[248]|b1)")
"""Numbers and truth values. A dtype is only made of a text that matches: others can mean objects or structures."""
_TEXT_DTYPE = re.compile(r"[<>=]?U[1-9][0-9]{0,3}")
"""Texts of up to so many characters, as numpy holds them: some clients send the prompt in an array."""
_MAX_ITEMS = 1_000_000
_MAX_NPY_HEADER_BYTES = 1000  # a plain array's has 118

Picture = Callable[[dict[Any, Any]], Any]
"""Reads the map of an encoded picture, whose kind is neither an array's nor raw."""


class NotAMessage(ProtocolError):
    """Bytes that are no msgpack message with plain values and arrays."""


def pack(value: Any, spelling: Spelling) -> bytes:
    """Packs plain values and numeric arrays as that peer reads them. Raises TypeError for anything else."""

    def spell(item: Any) -> Any:
        if isinstance(item, np.generic):
            return item.item()
        if isinstance(item, np.ndarray) and _DTYPE.fullmatch(item.dtype.str):
            return _spelled(item, spelling)
        raise TypeError(f"{type(item).__name__} has no place in a message")

    return bytes(msgpack.packb(value, default=spell))


def unpack(data: bytes, picture: Picture | None = None) -> Any:
    """The value in ``data``; arrays are read-only views, arrays of texts are texts in lists.

    Raises:
        NotAMessage: not msgpack, an array whose shape, type and bytes disagree, or a structure beyond any real
            message's; or whatever ``picture`` raises.
    """
    left = _MAX_ITEMS

    def counted(item: Any) -> Any:
        nonlocal left
        left -= 1 + len(item)
        if left < 0:  # each limit below is of one list: nested ones would multiply
            raise NotAMessage(f"{len(data)} bytes that hold more than {_MAX_ITEMS} values: send arrays, not lists")
        return item

    try:
        return msgpack.unpackb(
            data,
            object_hook=lambda item: _unspell(counted(item), picture),
            list_hook=counted,
            max_map_len=10_000,
            max_array_len=_MAX_ITEMS,
            max_ext_len=0,
        )
    except NotAMessage:
        raise
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as error:
        why = str(error) or type(error).__name__
        raise NotAMessage(f"{len(data)} bytes that are not a msgpack message: {why}") from None


def _spelled(array: NDArray[Any], spelling: Spelling) -> dict[Any, Any]:
    if spelling == "groot":
        file = io.BytesIO()
        np.save(file, array, allow_pickle=False)
        return {"__ndarray_class__": True, "as_npy": file.getvalue()}
    if spelling == "msgpack-numpy":
        return {
            b"nd": True, b"type": array.dtype.str, b"kind": b"", b"shape": list(array.shape), b"data": array.tobytes(),
        }  # fmt: skip
    key: Any = str.encode if spelling == "openpi" else str
    fields = {"__ndarray__": True, "data": array.tobytes(), "dtype": array.dtype.str, "shape": list(array.shape)}
    return {key(name): content for name, content in fields.items()}


def _unspell(item: dict[Any, Any], picture: Picture | None) -> Any:
    for key in (str, str.encode):
        if key("__ndarray__") in item:
            return _array(*(item.get(key(name)) for name in ("data", "dtype", "shape")))
        if key("__npgeneric__") in item:
            return item.get(key("data"))
        if key("__ndarray_class__") in item:
            return _npy(item.get(key("as_npy")))
        if key("nd") in item and key("type") in item:
            return _msgpack_numpy(*(item.get(key(name)) for name in ("nd", "data", "type", "shape")))
        if key("__ModalityConfig_class__") in item or key("__ModalityConfig__") in item:
            return _modality(item.get(key("as_json")))
    if "__image__" in item:
        if item.get("format") == "raw":
            return _array(item.get("data"), item.get("dtype"), item.get("shape"))
        if picture is None:
            raise NotAMessage("an encoded picture, where none is expected")
        return picture(item)
    return item


def _modality(content: Any) -> Any:
    """GR00T's description of a modality: a map, or from N1.5's servers the JSON of one."""
    if not isinstance(content, str):
        return content
    try:
        found = json.loads(content)
        msgpack.packb(found)  # JSON can spell half a character, and numbers that no message carries
        return found
    except (ValueError, OverflowError, RecursionError) as error:
        raise NotAMessage(f"a modality configuration that is no JSON: {error}") from None


def _msgpack_numpy(is_array: Any, data: Any, dtype: Any, shape: Any) -> Any:
    kind = dtype.decode("ascii", "replace") if isinstance(dtype, bytes) else dtype
    array = _array(data, kind, shape if is_array else [])
    return array.item() if isinstance(array, np.ndarray) and not is_array else array


def _npy(data: Any) -> NDArray[Any]:
    """The array of an ``.npy`` file, without numpy's own reader: it parses the header as Python."""
    header = (
        data[10:_MAX_NPY_HEADER_BYTES] if isinstance(data, bytes) and data.startswith(b"\x93NUMPY\x01\x00") else b""
    )
    found = re.match(
        rb"\{'descr': '([^']{1,8})', 'fortran_order': (True|False), 'shape': \(([0-9, ]*)\), \} *\n", header
    )
    if found is None or int.from_bytes(data[8:10], "little") != found.end():
        raise NotAMessage("an array in the npy format: expected version 1.0, and a plain array of numbers")
    shape = [int(side) for side in found[3].replace(b" ", b"").split(b",") if side]
    content, dtype = data[10 + found.end() :], found[1].decode("ascii", "replace")
    return _array(content, dtype, shape[::-1]).T if found[2] == b"True" else _array(content, dtype, shape)


def _array(data: Any, dtype: Any, shape: Any) -> Any:
    is_text = isinstance(dtype, str) and _TEXT_DTYPE.fullmatch(dtype) is not None
    if not isinstance(data, bytes) or not isinstance(dtype, str) or not (is_text or _DTYPE.fullmatch(dtype)):
        raise NotAMessage(f"an array of type {dtype!r}: expected the bytes of numbers, truth values or texts")
    sides, kind = shape_of(shape), np.dtype(dtype)
    if math.prod(sides) * kind.itemsize != len(data):
        raise NotAMessage(
            f"an array {sides} of {dtype}: expected {math.prod(sides) * kind.itemsize} bytes, {len(data)} came"
        )
    array = np.frombuffer(data, kind).reshape(sides)
    if not is_text:
        return array
    try:  # numpy does not check that they are characters
        data.decode("utf-32-be" if dtype.startswith(">") else "utf-32-le")
    except UnicodeDecodeError as error:
        raise NotAMessage(f"an array of type {dtype!r}: expected texts, came other bytes: {error.reason}") from None
    return array.tolist()


def shape_of(shape: Any) -> tuple[int, ...]:
    """The sides that a message names. Raises NotAMessage if they are no shape."""
    is_shape = isinstance(shape, list | tuple) and len(shape) <= MAX_DIMENSIONS
    if not is_shape or not all(type(side) is int and side >= 0 for side in shape):
        raise NotAMessage(f"an array of shape {shape!r}: expected at most {MAX_DIMENSIONS} sizes")
    return tuple(shape)
