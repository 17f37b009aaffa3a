"""Tensors on disk, by rows: each process writes its own, and any number of processes reads them back.

Each process has one safetensors file. torch.distributed.checkpoint would do the same, but its index is a pickle, which
may run code; and gathering on one process would need memory for the whole optimiser there.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor
from torch.distributed.tensor import DTensor

from dual_system.training.parallel import World, local
from protocol import disk
from protocol.files import require_file


def write_rows(tensors: Mapping[str, Tensor], folder: Path, stem: str, world: World) -> None:
    """Writes this process's rows to ``folder/stem-RANK-of-SIZE.safetensors`` and syncs the file.

    A tensor that every process holds whole is cut as FSDP2 would cut it.
    """
    path = folder / f"{stem}-{world.rank:05d}-of-{world.size:05d}.safetensors"
    save_file({name: _rows_to_write(tensor.detach(), world).contiguous() for name, tensor in tensors.items()}, path)
    disk.sync(path)


class RowReader:
    """Reads the files that all processes wrote with ``write_rows``."""

    def __init__(self, folder: Path, stem: str, world: World) -> None:
        """Raises FileNotFoundError if a process's file is missing."""
        self._world = world
        paths = sorted(folder.glob(f"{stem}-*-of-*.safetensors"))
        wanted = int(paths[0].stem.rsplit("-", 1)[1]) if paths else 1
        if len(paths) != wanted:
            raise FileNotFoundError(
                f"{folder}: {len(paths)} of {wanted} files {stem}-*.safetensors; every process and host must see the "
                "same --out"
            )
        self._paths = paths
        self._files: list[Any] = []
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Raises OSError or ValueError if a file may not be read or is damaged."""
        for path in self._paths:
            require_file(path)
            try:
                self._files.append(self._stack.enter_context(safe_open(path, framework="pt")))
            except SafetensorError as error:
                raise ValueError(f"{path} was cut short: {error}; take the checkpoint out of the way") from error
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def names(self) -> set[str]:
        return set(self._files[0].keys())

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of the whole tensor."""
        shapes = [tuple(file.get_slice(name).get_shape()) for file in self._files]
        return (sum(shape[0] for shape in shapes), *shapes[0][1:]) if shapes[0] else ()

    def read(self, name: str, like: Tensor) -> Tensor:
        """The rows of tensor ``name`` that this process holds of ``like``."""
        if not self.shape(name):
            scalar: Tensor = self._files[0].get_tensor(name)
            return scalar
        start, stop = held_rows(like, self._world)
        parts, first = [], 0
        for file in self._files:
            rows = file.get_slice(name)
            count = rows.get_shape()[0]
            low, high = max(start - first, 0), min(stop - first, count)
            if low < high:
                parts.append(rows[low:high])
            first += count
        return torch.cat(parts) if parts else local(like).new_empty(0, *like.shape[1:])


def held_rows(tensor: Tensor, world: World) -> tuple[int, int]:
    """The range [first, last + 1) of rows that this process holds."""
    count = tensor.shape[0] if tensor.ndim else 1
    return _cut(count, world) if isinstance(tensor, DTensor) else (0, count)


def _rows_to_write(tensor: Tensor, world: World) -> Tensor:
    if isinstance(tensor, DTensor) or not tensor.ndim:
        return local(tensor)
    start, stop = _cut(len(tensor), world)
    return tensor[start:stop]


def _cut(count: int, world: World) -> tuple[int, int]:
    """This process's range of ``count`` rows, cut like ``torch.chunk`` as in FSDP2."""
    rows = -(-count // world.size)
    return min(world.rank * rows, count), min((world.rank + 1) * rows, count)
