"""Decoded pictures on disk, at the networks' sizes, or what frozen towers make of them: once, not per process and run.

There is one file per system and episode, so that a run finds what another one with the same tower has stored. A process
writes a missing file; several may do so at once with the same bytes.
"""

from __future__ import annotations

import hashlib
import uuid
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dual_system.training.episode import Frame

Views = list[tuple[Frame, ...]]
"""Per instant, one picture per view; empty tuples if no view is read. A demonstration's instants come first, and may
have fewer views than the robot's."""


class PictureStore:
    """A folder of decoded pictures."""

    def __init__(self, folder: Path, kind: str) -> None:
        """``kind`` identifies all that pictures depend on besides the episode; a folder may hold several kinds.

        Raises OSError if the folder cannot be made.
        """
        self.folder = folder / _name(kind.encode())
        self.folder.mkdir(parents=True, exist_ok=True)

    def read(self, episode: bytes, num_instants: int) -> Views | None:
        """The views that `write` stored; None if the file is missing or damaged."""
        try:
            with (self.folder / f"{_name(episode)}.npz").open("rb") as file:  # np.load would leave a damaged one open
                arrays = dict(np.load(file, allow_pickle=False))
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):
            return None
        views = _instants([arrays[key] for key in sorted(arrays, key=int)], num_instants)
        return views if len(views) == num_instants else None

    def has(self, episode: bytes) -> bool:
        """Whether there is a file of this episode."""
        return (self.folder / f"{_name(episode)}.npz").exists()

    def write(self, episode: bytes, views: Views) -> None:
        """Stores pictures, or features of one shape. Does nothing if the disk is full: training goes on without."""
        path = self.folder / f"{_name(episode)}.npz"
        partial = path.with_suffix(f".{uuid.uuid4().hex}")  # unique among processes and hosts
        try:
            with partial.open("wb") as file:
                np.savez(file, **_arrays(views))  # type: ignore[arg-type]  # no view is called allow_pickle
            partial.rename(path)
        except OSError:
            partial.unlink(missing_ok=True)


def _name(key: bytes) -> str:
    return hashlib.blake2b(key, digest_size=12).hexdigest()


def _arrays(views: Views) -> dict[str, NDArray[np.uint8 | np.float16]]:
    """By its number: (instants, *picture) of each view, for the last instants, those that have it."""
    return {
        str(number): np.stack([pictures[number] for pictures in views if number < len(pictures)])
        for number in range(max(map(len, views), default=0))
    }


def _instants(arrays: list[NDArray[np.uint8 | np.float16]], num_instants: int) -> Views:
    if not arrays:
        return [()] * num_instants
    count = len(arrays[0])
    late = [count - len(array) for array in arrays]  # the first instant with each view
    return [
        tuple(array[instant - first] for array, first in zip(arrays, late, strict=True) if instant >= first)
        for instant in range(count)
    ]
