"""What networks read of an episode's pictures, kept on a disk: videos are decoded once, not once per process and stage.

One file per episode and sight. Whoever misses one makes it; several may do so at once, and write the same bytes.
"""

from __future__ import annotations

import hashlib
import uuid
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dual_system.training.training_episode import Frame

Views = list[tuple[Frame, ...]]
"""Of every instant, one picture per view; () where none are read."""


class SightStore:
    """A folder of sights of one kind."""

    def __init__(self, folder: Path, kind: str) -> None:
        """``kind`` tells everything that pictures depend on but the episode; a folder may hold several kinds.

        Raises OSError if the folder cannot be made.
        """
        self._folder = folder / _name(kind.encode())
        self._folder.mkdir(parents=True, exist_ok=True)

    def read(self, episode: bytes, num_instants: int, names: tuple[str, ...]) -> tuple[Views, ...] | None:
        """What `write` was given under these names; None if it is not there or is damaged: make it again."""
        try:
            with (self._folder / f"{_name(episode)}.npz").open("rb") as file:  # np.load leaves a damaged one open
                arrays = dict(np.load(file, allow_pickle=False))
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):
            return None
        found = tuple(_instants(arrays, name, num_instants) for name in names)
        return found if all(len(views) == num_instants for views in found) else None

    def write(self, episode: bytes, views: dict[str, Views]) -> None:
        """Keeps pictures (height, width, 3) uint8. A disk that is full keeps nothing, and training goes on."""
        path = self._folder / f"{_name(episode)}.npz"
        partial = path.with_suffix(f".{uuid.uuid4().hex}")  # of no other process, on whichever host
        try:
            with partial.open("wb") as file:
                np.savez(file, **_arrays(views))  # type: ignore[arg-type]  # no view is called allow_pickle
            partial.rename(path)
        except OSError:
            partial.unlink(missing_ok=True)


def _name(of: bytes) -> str:
    return hashlib.blake2b(of, digest_size=12).hexdigest()


def _arrays(views: dict[str, Views]) -> dict[str, NDArray[np.uint8]]:
    """``name/number``: (instants, height, width, 3) of each view."""
    return {
        f"{name}/{number}": np.stack(pictures)
        for name, instants in views.items()
        for number, pictures in enumerate(zip(*instants, strict=True))
    }


def _instants(arrays: dict[str, NDArray[np.uint8]], name: str, num_instants: int) -> Views:
    mine = [array for key, array in arrays.items() if key.rpartition("/")[0] == name]
    return list(zip(*mine, strict=True)) if mine else [()] * num_instants
