"""model.safetensors.packed: a safetensors file without loss, smaller by a fifth where numbers are in half precision.

Of such a number the first byte is sign, exponent and two bits of the fraction. A network's weights have few exponents,
so LZMA leaves two thirds of these bytes; the other ones are noise. All first bytes come before all others here, which
is called a byte shuffle where arrays are compressed (Blosc, HDF5). It is for pairs that lie in a repository: a reader
has to unpack all of it.
"""

from __future__ import annotations

import lzma
import struct
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

_MAGIC = b"ppack1\r\n"
_HEADER = struct.Struct("<8sQQ")  # magic, bytes of the safetensors file, bytes of its packed even ones


def pack(safetensors: bytes) -> bytes:
    """What `unpack` makes the same bytes of again."""
    every_byte = np.frombuffer(safetensors, np.uint8)
    even, odd = (lzma.compress(every_byte[first::2].tobytes(), preset=9) for first in range(2))
    return _HEADER.pack(_MAGIC, len(safetensors), len(even)) + even + odd


def unpack(packed: bytes) -> bytes:
    """The bytes of the safetensors file.

    Raises:
        ValueError: these bytes are not packed ones, or were cut short.
    """
    if len(packed) < _HEADER.size or not packed.startswith(_MAGIC):
        raise ValueError(f"{len(packed)} bytes that do not begin as a packed file does")
    _, size, num_even = _HEADER.unpack_from(packed)
    parts = packed[_HEADER.size : _HEADER.size + num_even], packed[_HEADER.size + num_even :]
    every_byte = np.empty(size, np.uint8)
    try:
        for first, part in enumerate(parts):
            every_byte[first::2] = np.frombuffer(lzma.decompress(part), np.uint8)
    except (lzma.LZMAError, ValueError) as error:
        raise ValueError(f"a packed file of {size} bytes cannot be unpacked: {error}") from error
    return every_byte.tobytes()


class PackedFile:
    """An open one, read as safetensors' ``safe_open`` gives it."""

    def __init__(self, path: Path) -> None:
        """Raises SafetensorError if it cannot be read."""
        try:
            self._tensors = load(unpack(path.read_bytes()))
        except ValueError as error:
            raise SafetensorError(str(error)) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._tensors = {}

    def keys(self) -> list[str]:
        return list(self._tensors)

    def get_tensor(self, name: str) -> Tensor:
        return self._tensors[name]

    def get_slice(self, name: str) -> _Slice:
        return _Slice(self._tensors[name])


class _Slice:
    def __init__(self, tensor: Tensor) -> None:
        self._tensor = tensor

    def get_shape(self) -> list[int]:
        return list(self._tensor.shape)
