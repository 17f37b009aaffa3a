"""Three ROS 2 messages as rosbag2 stores them: sensor_msgs' Image, CompressedImage and JointState in CDR.

Source: OMG's CDR (alignment counts from behind the four bytes of encapsulation) and the .msg files of
common_interfaces, which every ROS 2 release shares. A decoder of any type by its schema would be a dependency more, and
an array of pixels a list of numbers.
"""

from __future__ import annotations

import io
import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from protocol.checks import MAX_IMAGE_SIDE_PX
from protocol.images import claimed_size, from_jpeg

IMAGE, COMPRESSED, JOINTS = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "JointState"))
Pixels = NDArray[np.uint8]

_CHANNELS = {
    "rgb8": (0, 1, 2),
    "bgr8": (2, 1, 0),
    "rgba8": (0, 1, 2),
    "bgra8": (2, 1, 0),
    "mono8": (0, 0, 0),
}
"""Places of red, green and blue in a pixel."""
_NUM_CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}
_JPEG = b"\xff\xd8"


class JointState(NamedTuple):
    """Names, and as many positions and velocities, or none of them."""

    stamp_ns: int
    names: tuple[str, ...]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]


class _Cdr:
    """Reads one message from its beginning to its end."""

    def __init__(self, data: bytes) -> None:
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
            raise ValueError(
                f"expected CDR, big or little endian, came an encapsulation of {data[:2].hex() or 'nothing'}"
            )
        self._data, self._at, self._order = memoryview(data)[4:], 0, "<" if data[1] else ">"

    def number(self, kind: str) -> Any:
        """One number of a kind of `struct`."""
        size = struct.calcsize(kind)
        at = -(-self._at // size) * size
        self._at = at + size
        return struct.unpack(self._order + kind, self._taken(at, size))[0]

    def raw(self) -> memoryview:
        """A sequence of bytes, or a text with its closing zero."""
        size = self.number("I")
        self._at += size
        return self._taken(self._at - size, size)

    def text(self) -> str:
        return bytes(self.raw()).rstrip(b"\0").decode()

    def texts(self) -> tuple[str, ...]:
        return tuple(self.text() for _ in range(self._count(4)))

    def doubles(self) -> NDArray[np.float64]:
        if not (count := self._count(8)):
            return np.zeros(0)
        at = -(-self._at // 8) * 8
        self._at = at + 8 * count
        return np.frombuffer(self._taken(at, 8 * count), f"{self._order}f8").astype(np.float64)

    def stamp_ns(self) -> int:
        """The stamp of a std_msgs/Header, which is read over."""
        seconds, rest_ns = self.number("i"), self.number("I")
        self.raw()
        return int(seconds) * 1_000_000_000 + int(rest_ns)

    def _count(self, least_bytes: int) -> int:
        count = int(self.number("I"))
        if count * least_bytes > len(self._data):
            raise ValueError(f"{count} elements in a message of {len(self._data)} bytes")
        return count

    def _taken(self, at: int, size: int) -> memoryview:
        if at + size > len(self._data):
            raise ValueError(f"it ends at byte {len(self._data)}, expected {at + size}")
        return self._data[at : at + size]


def stamp_of(data: bytes) -> int:
    """Stamp [ns] of a message that begins with a std_msgs/Header. Raises ValueError if it is damaged."""
    return _Cdr(data).stamp_ns()


def joints_of(data: bytes) -> JointState:
    """Decodes a JointState. Raises ValueError if it is damaged, or has other numbers than names."""
    cdr = _Cdr(data)
    found = JointState(cdr.stamp_ns(), cdr.texts(), cdr.doubles(), cdr.doubles())
    for field, values in (("position", found.position), ("velocity", found.velocity)):
        if len(values) not in (0, len(found.names)):
            raise ValueError(f"{len(found.names)} names and {len(values)} numbers of {field}")
    return found


def picture_of(schema: str, data: bytes) -> Pixels:
    """Decodes an Image or a CompressedImage to (height, width, 3) RGB.

    Raises ValueError if it is damaged, larger than any camera's, or in an encoding that is not read.
    """
    cdr = _Cdr(data)
    cdr.stamp_ns()
    if schema == COMPRESSED:
        cdr.text()  # "jpeg", "rgb8; jpeg compressed bgr8" and others: what it holds tells better
        return _decompressed(bytes(cdr.raw()))
    height, width, encoding = cdr.number("I"), cdr.number("I"), cdr.text()
    cdr.number("B")  # whether 16-bit numbers are big endian
    step, pixels = cdr.number("I"), cdr.raw()
    if encoding not in _CHANNELS:
        raise ValueError(f"an encoding {encoding!r}; expected {', '.join(_CHANNELS)}")
    size = _NUM_CHANNELS[encoding]
    if not (0 < height <= MAX_IMAGE_SIDE_PX and 0 < width <= MAX_IMAGE_SIDE_PX) or step < width * size:
        raise ValueError(f"{height} x {width} px of {encoding} with {step} bytes a row")
    if len(pixels) != height * step:
        raise ValueError(f"{height} rows of {step} bytes in {len(pixels)} bytes")
    rows = np.frombuffer(pixels, np.uint8).reshape(height, step)[:, : width * size]
    return np.ascontiguousarray(rows.reshape(height, width, size)[:, :, _CHANNELS[encoding]])


def _decompressed(data: bytes) -> Pixels:
    claimed_size(data)
    if data.startswith(_JPEG):
        return from_jpeg(data)
    return np.array(Pillow.open(io.BytesIO(data)).convert("RGB"))
