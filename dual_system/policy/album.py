"""Pictures of still scenes and their labels, kept in one file: made once, in minutes, and read for every tower."""

from __future__ import annotations

import multiprocessing
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dual_system.models.windows import seen_through
from dual_system.policy.locating import Labels, labels_of
from dual_system.policy.studio import WINDOWS, Still, Studio

IMAGE_PX = 64
FIRST_SEED = 5_000_000
_A_TURN = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Album:
    """N pictures of one camera."""

    pictures: Tensor
    """(N, 64, 64, 3) uint8"""
    labels: Labels

    def split(self, count: int) -> tuple[Album, Album]:
        """All but the last ``count`` pictures, and these."""
        index = torch.arange(len(self.pictures))
        return self._of(index[:-count]), self._of(index[-count:])

    def _of(self, index: Tensor) -> Album:
        return Album(pictures=self.pictures[index], labels=self.labels[index])


def albums(file: Path, count: int, workers: int) -> dict[str, Album]:
    """The first ``count`` scenes by camera, from the file, or photographed and written there."""
    if not file.is_file():
        turns = [range(first, min(first + _A_TURN, count)) for first in range(0, count, _A_TURN)]
        with multiprocessing.get_context("spawn").Pool(workers) as pool:
            stills = [still for turn in pool.imap(_photographed, turns) for still in turn]
        _write(file, stills)
    with np.load(file, allow_pickle=False) as kept:
        return {
            camera: Album(
                pictures=torch.from_numpy(kept[f"{camera}.pictures"]),
                labels=Labels(
                    **{each.name: torch.from_numpy(kept[f"{camera}.{each.name}"]) for each in fields(Labels)}
                ),
            )
            for camera in WINDOWS
        }


def _write(file: Path, stills: Sequence[Still]) -> None:
    arrays: dict[str, Any] = {}
    for camera in WINDOWS:
        labels = labels_of(stills, camera)
        arrays[f"{camera}.pictures"] = np.stack([still.views[camera] for still in stills])
        arrays |= {f"{camera}.{each.name}": getattr(labels, each.name).numpy() for each in fields(Labels)}
    file.parent.mkdir(parents=True, exist_ok=True)
    fresh = file.with_name("fresh_" + file.name)
    np.savez(fresh, **arrays)
    fresh.rename(file)


def _photographed(numbers: Sequence[int]) -> list[Still]:
    studio = Studio()
    try:
        return [_seen(studio.still(FIRST_SEED + number)) for number in numbers]
    finally:
        studio.close()


def _seen(still: Still) -> Still:
    size = (IMAGE_PX, IMAGE_PX)
    return replace(still, views={name: seen_through(WINDOWS[name], view, size) for name, view in still.views.items()})
