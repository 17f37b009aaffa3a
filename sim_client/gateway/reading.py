"""Reads values from a client's message; errors name the expected value, the actual one, and the way out."""

from __future__ import annotations

import contextlib
import hmac
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.messages import Floats
from sim_client.gateway.arrays import unpack
from sim_client.gateway.exchange import Frames, Packet, Refused
from sim_client.gateway.pictures import EncodedPicture

log = logging.getLogger(__name__)


def message(packet: Packet) -> dict[Any, Any]:
    """The map that every dialect's packets are. Raises Refused for anything else."""
    if isinstance(packet, str):
        raise Refused("expected a binary message of msgpack, came text")
    value = unpack(packet)
    if not isinstance(value, dict):
        raise Refused(f"expected a msgpack map, came {type(value).__name__}")
    return value


def field(values: Mapping[Any, Any], key: str, why: str) -> Any:
    """``values[key]``, or with slashes in the key the entry of a map within. Raises Refused if there is none."""
    found: Any = values
    for name in (key,) if key in values else key.split("/"):
        if not isinstance(found, Mapping) or name not in found:
            raise Refused(f"expected {key!r} ({why}), came {_names(values)}")
        found = found[name]
    return found


def text(values: Mapping[Any, Any], key: str) -> str:
    """A sentence; of a list of wordings the first, as the benchmark's own policies do."""
    value = field(values, key, "what the robot is to do")
    if isinstance(value, Sequence) and not isinstance(value, str | bytes) and value:
        value = value[0]
    if isinstance(value, bytes):
        with contextlib.suppress(UnicodeDecodeError):
            value = value.decode()
    if not isinstance(value, str) or not value.strip():
        raise Refused(f"{key}: expected a sentence that says what to do, came {shown(value)}")
    return value


def word(value: Any, key: str, expected: str = "a text") -> str:
    """A text of the protocol's own, such as the kind of a message. Raises Refused for anything else."""
    if not isinstance(value, str):
        raise Refused(f"{key}: expected {expected}, came {shown(value)}")
    return value


def truth(value: Any, key: str) -> bool:
    """A truth value, or 0 or 1, plain or as the only item of a list or an array. Raises Refused for anything else."""
    items = value.ravel().tolist() if isinstance(value, np.ndarray) else value
    only = items[0] if isinstance(items, list) and len(items) == 1 else items
    if not isinstance(only, bool | int | float | np.generic) or only not in (False, True):
        raise Refused(f"{key}: expected true or false, came {shown(value)}")
    return bool(only)


def is_secret(value: Any, secret: str) -> bool:
    """Whether a client sent ``secret``. The time that this takes says nothing of how much of it was right."""
    return isinstance(value, str) and hmac.compare_digest(value.encode(), secret.encode())


def listed(value: Any, key: str) -> Sequence[Any]:
    """A list, or an array with an axis to go along. Raises Refused for anything else."""
    is_list = value.ndim > 0 if isinstance(value, np.ndarray) else isinstance(value, list)
    if not is_list:
        raise Refused(f"{key}: expected a list, came {shown(value)}")
    return value  # type: ignore[no-any-return]


def vector(value: Any, name: str, expected: str = "numbers") -> Floats:
    """Numbers in one row, as float32. Raises Refused for what holds anything else, or lists that are not alike."""
    try:
        return np.asarray(value, np.float32).ravel()
    except (TypeError, ValueError, OverflowError):
        raise Refused(f"{name}: expected {expected}, came {shown(value)}") from None


def numbers(value: Any, name: str, expected: int) -> Floats:
    """One vector of ``expected`` finite numbers, as float32."""
    found = vector(value, name, f"{expected} numbers")
    if len(found) != expected:
        raise Refused(
            f"{name}: expected {expected} numbers, came {len(found)}. A robot of another build needs --robot-file."
        )
    if not np.isfinite(found).all():
        raise Refused(f"{name}: expected finite numbers, came {found.tolist()}")
    return found


def picture(value: Any, name: str) -> NDArray[np.uint8]:
    """Pixels (height, width, 3) uint8."""
    frame = value.decode() if isinstance(value, EncodedPicture) else value
    if not isinstance(frame, np.ndarray) or frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        came = f"{frame.shape} of {frame.dtype}" if isinstance(frame, np.ndarray) else type(frame).__name__
        raise Refused(f"{name}: expected a picture (height, width, 3) of uint8, came {came}")
    return frame


def frames(pictures: Mapping[Any, Any], cameras: Mapping[str, str]) -> Frames:
    """One picture per camera of ours: under its key; where that is empty, under our camera's own name, and for cameras
    without one the others in the client's order. A picture that is read by no camera is named in the log.

    Raises:
        Refused: a camera has no picture, or more pictures came in the client's order than there are cameras for them.
    """
    keys = {camera: key or camera for camera, key in cameras.items() if key or camera in pictures}
    found = {camera: picture(field(pictures, key, f"the {camera} camera"), key) for camera, key in keys.items()}
    if len(keys) < len(cameras):
        rest = [name for name in pictures if name not in keys.values()]
        if len(rest) != len(cameras) - len(keys):
            expected = f"{len(cameras)} ({', '.join(cameras)})"
            way_out = ". Say with --cameras NAME=KEY which camera is which" if len(pictures) > len(cameras) else ""
            raise Refused(f"pictures: expected {expected}, came {len(pictures)} ({_names(pictures)}){way_out}")
        unnamed = (camera for camera in cameras if camera not in keys)
        return found | {camera: picture(pictures[name], str(name)) for camera, name in zip(unnamed, rest, strict=True)}
    tell_unread(name for name in _pictures_in(pictures) if name not in keys.values())
    return found


def tell_unread(names: Iterable[str]) -> None:
    """Says in the log, once, under which names came pictures that no camera of ours is for."""
    if unread := tuple(sorted(name[:80] for name in names))[:12]:
        _tell_once(unread)


@lru_cache(maxsize=64)
def _tell_once(names: tuple[str, ...]) -> None:
    log.warning("pictures that no camera of ours is for: %s; see --cameras and the mapping file", ", ".join(names))


def _pictures_in(values: Mapping[Any, Any]) -> Iterator[str]:
    for name, value in values.items():
        for inner, each in value.items() if isinstance(value, Mapping) else (("", value),):
            is_pixels = isinstance(each, np.ndarray) and each.dtype == np.uint8 and each.ndim >= 3
            if is_pixels or isinstance(each, EncodedPicture):
                yield f"{name}/{inner}" if inner else str(name)


def videos(streams: Mapping[str, Sequence[Any]]) -> Sequence[Frames]:
    """Lists of frames, one per camera, as one list of instants; its pictures are decoded when they are read."""
    lengths = {name: len(stream) for name, stream in streams.items()}
    if len(set(lengths.values())) > 1:
        came = ", ".join(f"{name}: {length}" for name, length in lengths.items())
        raise Refused(f"expected a list of frames per camera, equally long, came {came}")
    return _Video(streams, next(iter(lengths.values()), 0))


class _Video(Sequence[Frames]):
    def __init__(self, streams: Mapping[str, Sequence[Any]], length: int) -> None:
        self._streams, self._length = streams, length

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[position] for position in range(*index.indices(self._length))]
        return {name: picture(stream[index], name) for name, stream in self._streams.items()}


def shown(value: Any) -> str:
    """A client's value in an error: a plain one itself, of others the type, and of an array the shape."""
    if value is None or isinstance(value, bool | int | float | str | bytes | np.generic):
        return repr(value[:80] if isinstance(value, str | bytes) else value)
    return f"an array of shape {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__


def _names(values: Mapping[Any, Any]) -> str:
    return ", ".join(repr(key) for key in list(values)[:12]) or "nothing"
