"""Writes safetensors files piece by piece: bytes are copied, so a dtype stays and memory holds one piece."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from dual_system.models.official.header import ITEM_BYTES, FolderError, Shape, Stored, pieces

DTYPES = {"BF16": torch.bfloat16, "F16": torch.float16, "F32": torch.float32}


@dataclass(frozen=True, slots=True)
class Entry:
    """One tensor to write: another file's bytes or own ones, and bytes that replace some from ``patch_at`` on."""

    name: str
    dtype: str
    shape: Shape
    source: Stored | bytes
    patch: bytes = b""
    patch_at: int = 0

    @property
    def num_bytes(self) -> int:
        return math.prod(self.shape) * ITEM_BYTES[self.dtype]


def read(path: Path, tensor: Stored) -> Tensor:
    """One small tensor of a file, in its own dtype."""
    with path.open("rb") as file:
        raw = bytearray(b"".join(pieces(file, tensor)))
    return torch.frombuffer(raw, dtype=DTYPES[tensor.dtype]).reshape(tensor.shape)


def raw(tensor: Tensor, dtype: str) -> bytes:
    """The bytes of a tensor as ``dtype``, little-endian."""
    return tensor.to(DTYPES[dtype]).contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()


def write(path: Path, source: Path, entries: Sequence[Entry]) -> None:
    """Writes ``entries``, their bytes from ``source``. Raises FolderError if an entry is not as long as its shape."""
    # The widest items first: every tensor is then aligned to its items.
    ordered = sorted(entries, key=lambda entry: (-ITEM_BYTES[entry.dtype], entry.name))
    header: dict[str, object] = {"__metadata__": {"format": "pt"}}
    at = 0
    for entry in ordered:
        header[entry.name] = {
            "dtype": entry.dtype,
            "shape": entry.shape,
            "data_offsets": (at, at + entry.num_bytes),
        }
        at += entry.num_bytes
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    with path.open("wb") as out, source.open("rb") as file:
        out.write(len(text).to_bytes(8, "little") + text)
        for entry in ordered:
            begin = out.tell()
            for piece in [entry.source] if isinstance(entry.source, bytes) else pieces(file, entry.source):
                out.write(piece)
            if out.tell() - begin != entry.num_bytes:
                raise FolderError(f"{entry.name}: {entry.dtype} {entry.shape} is not {out.tell() - begin} bytes")
            if entry.patch:
                out.seek(begin + entry.patch_at)
                out.write(entry.patch)
                out.seek(begin + entry.num_bytes)
