"""A safetensors file by its header: what it holds is known before a tensor is read, and bytes are read in pieces.

A file may end anywhere behind its header, as an HTTP range request brings it: everything but the numbers is then known.
Layout: 8 bytes little-endian length n, n bytes of JSON, tensors. Source: the safetensors format's public description.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

CONFIG_FILE, WEIGHTS_FILE, STATISTICS_FILE = "config.json", "model.safetensors", "norm_stats.json"
"""The official folder."""
PIECE_BYTES = 8 * 2**20
MAX_HEADER_BYTES = 100_000_000
ITEM_BYTES = {
    "F64": 8, "I64": 8, "U64": 8, "F32": 4, "I32": 4, "U32": 4, "F16": 2, "BF16": 2, "I16": 2, "U16": 2,
    "F8_E4M3": 1, "F8_E5M2": 1, "I8": 1, "U8": 1, "BOOL": 1,
}  # fmt: skip

Shape = tuple[int, ...]


class FolderError(ValueError):
    """A folder is not the official release as far as this importer can explain it."""


@dataclass(frozen=True, slots=True)
class Stored:
    """One tensor of a file; its bytes are ``[begin, end)`` of the whole file."""

    name: str
    dtype: str
    shape: Shape
    begin: int
    end: int

    @property
    def num_bytes(self) -> int:
        return self.end - self.begin

    @property
    def num_elements(self) -> int:
        return math.prod(self.shape)


@dataclass(frozen=True, slots=True)
class Header:
    """The tensors of one file."""

    path: Path
    sha256: str
    """sha256 over the header's JSON: equal for files of the same names, dtypes, shapes and order."""
    tensors: Mapping[str, Stored]
    num_bytes: int
    """Size of the whole file."""
    has_numbers: bool
    """False if this one ends before."""


def read_header(path: Path) -> Header:
    """Reads the header of ``path``.

    Raises:
        FileNotFoundError: there is no such file.
        FolderError: no safetensors file, longer than its header says, or a name twice.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: not there. The official folder holds its weights in one model.safetensors.")
    size = path.stat().st_size
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        if not 2 <= length <= min(size - 8, MAX_HEADER_BYTES):
            raise FolderError(
                f"{path}: expected a safetensors header of 2..{MAX_HEADER_BYTES} bytes within {size} bytes, came "
                f"{length}. A git-lfs pointer or a broken download? Fetch the file again."
            )
        raw = file.read(length)
    try:
        values = json.loads(raw, object_pairs_hook=_without_duplicates)
    except ValueError as error:
        raise FolderError(f"{path}: the safetensors header does not parse: {error}") from error
    values.pop("__metadata__", None)
    tensors = {name: _stored(path, name, value, 8 + length) for name, value in values.items()}
    wanted = max((tensor.end for tensor in tensors.values()), default=8 + length)
    if size > wanted:
        raise FolderError(f"{path}: the header describes {wanted} bytes, the file has {size}. Fetch it again.")
    return Header(
        path=path,
        sha256=hashlib.sha256(raw).hexdigest(),
        tensors=tensors,
        num_bytes=wanted,
        has_numbers=size == wanted,
    )


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"twice: {sorted({name for name in names if names.count(name) > 1})}")
    return found


def _stored(path: Path, name: str, value: Any, base: int) -> Stored:
    try:
        dtype, shape = str(value["dtype"]), tuple(int(size) for size in value["shape"])
        first, last = (int(offset) for offset in value["data_offsets"])
    except (TypeError, KeyError, ValueError) as error:
        raise FolderError(f"{path}: tensor {name!r}: expected dtype, shape and data_offsets, came {value!r}") from error
    if dtype not in ITEM_BYTES:
        raise FolderError(f"{path}: tensor {name!r}: expected a dtype of {', '.join(ITEM_BYTES)}, came {dtype!r}")
    if last - first != math.prod(shape) * ITEM_BYTES[dtype] or first < 0:
        raise FolderError(f"{path}: tensor {name!r}: {dtype} {shape} does not fill bytes {first}..{last}")
    return Stored(name, dtype, shape, base + first, base + last)


def pieces(file: BinaryIO, tensor: Stored, max_bytes: int | None = None) -> Iterator[bytes]:
    """Yields the tensor's bytes in order, at most ``PIECE_BYTES`` at a time; of its first ``max_bytes`` if given."""
    file.seek(tensor.begin)
    left = tensor.num_bytes if max_bytes is None else min(max_bytes, tensor.num_bytes)
    while left:
        piece = file.read(min(PIECE_BYTES, left))
        if not piece:
            raise FolderError(f"{tensor.name}: the file ended {left} bytes early. Fetch it again.")
        yield piece
        left -= len(piece)


def are_equal(path: Path, one: Stored, other: Stored, max_bytes: int | None = None) -> bool:
    """Whether two tensors of a file have the same bytes, in their first ``max_bytes`` if given."""
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    with path.open("rb") as first, path.open("rb") as second:
        pairs = zip(pieces(first, one, max_bytes), pieces(second, other, max_bytes), strict=True)
        return all(mine == theirs for mine, theirs in pairs)
