"""Reads a dataset of ours: episodes, their rows, and any of their pictures. Needs neither torch nor lerobot."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_system.data import lerobot_files as layout
from dual_system.data import lerobot_v3 as v3
from dual_system.data.episode import DEMO_CAMERA, EXECUTED, OPTIONAL, TCP_POSE, Rows, from_table
from dual_system.data.errors import DatasetError
from dual_system.data.lerobot_folder import LeRobotFolder
from dual_system.data.video import FPS


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One episode of a dataset, as ``meta/episodes`` lists it."""

    index: int
    task: str
    instruction: str
    seed: int
    difficulty: str
    origin: str
    is_success: bool
    recovery: str
    num_rejected: int
    noise_rad: float  # 0 without noise
    num_rows: int
    num_demonstration_rows: int
    corrected_from: int  # see `About`
    first_row: int  # its number among all rows of the dataset


class Dataset:
    """A v3 folder that `pp-collect` or `pp-export` made, or LeRobot's tools from such folders.

    Episodes are known by their ``episode_index``, which need not count from 0.

    Attributes:
        cameras: names of the robot's cameras, in the order that models read them.
        demo_cameras: those of demonstrations; another body's has one of its own (`DEMO_CAMERA`).
        state_dim, action_dim: how many numbers a row has of each.

    Raises:
        DatasetError: the folder holds no such dataset, or a broken one (`LeRobotFolder`).
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._folder = LeRobotFolder(root)
        self.described = self._folder.info
        missing = sorted({*_LISTED} - self._folder.listed[0].keys())
        if missing:
            raise DatasetError(
                f"{root} is a LeRobot {layout.VERSION} dataset, but not one of ours: meta/episodes lacks "
                f"{', '.join(missing)}; pp-collect and pp-export write ours"
            )
        if self._folder.fps != FPS:
            raise DatasetError(f"{root} has {self._folder.fps} rows a second; datasets here have {FPS}")
        videos = [name.removeprefix(_VIDEO) for name in self._folder.cameras if name.startswith(_VIDEO)]
        self.cameras = tuple(camera for camera in videos if camera != DEMO_CAMERA)
        self.demo_cameras = (DEMO_CAMERA,) if DEMO_CAMERA in videos else self.cameras
        if not self.cameras:
            raise DatasetError(f"{root / layout.INFO_PATH}: no camera's videos; expected features {_VIDEO}NAME")
        features = self._folder.features
        self.image_px = _side_px(root, {camera: features[layout.video_key(camera)].get("shape") for camera in videos})
        self.state_dim, self.action_dim = (_size(root, features, name) for name in ("observation.state", "action"))
        self.episodes = tuple(_entry(root, listed) for listed in self._folder.listed)

    def rows(self, episode: int) -> Rows:
        """The rows of an episode.

        Raises:
            DatasetError: the file is broken, its rows are not those that ``meta/episodes`` lists, or a number of a
                row is not finite.
        """
        theirs = {ours: name for name, ours in v3.OUR_NAMES.items()}
        wanted = [each.name for each in fields(Rows) if each.name not in OPTIONAL or each.name in self._folder.features]
        table = self._folder.rows(episode, [theirs.get(name, name) for name in wanted]).rename_columns(wanted)
        try:
            rows = from_table(
                table,
                {"state": self.state_dim, "action": self.action_dim, EXECUTED: self.action_dim, TCP_POSE: 7},
            )
        except ValueError as error:
            raise DatasetError(f"{self.root}: episode {episode}: {error}") from None
        return rows

    def frames(self, episode: int, camera: str, rows: Sequence[int]) -> NDArray[np.uint8]:
        """The pictures (n, image_px, image_px, 3) that one camera took in some rows, which ascend.

        Raises:
            IndexError: the episode has no such row.
            DatasetError: the video is broken.
        """
        return self._folder.frames(episode, layout.video_key(camera), rows)

    def views(self, entry: Entry, rows: Sequence[int]) -> Iterator[tuple[NDArray[np.uint8], ...]]:
        """Yields the pictures of each of some rows, which ascend: the robot's cameras', a demonstration's its own.

        Raises: as `frames`.
        """
        split = bisect_left(rows, entry.num_demonstration_rows)
        for cameras, part in ((self.demo_cameras, rows[:split]), (self.cameras, rows[split:])):
            if part:
                yield from zip(*(self.frames(entry.index, camera, part) for camera in cameras), strict=True)


_VIDEO = layout.video_key("")
_SAME = ("task", "seed", "difficulty", "origin", "is_success", "recovery", "num_rejected", "num_demonstration_rows")
_LISTED = {
    "tasks": list,
    "seed": int,
    "is_success": bool,
    "num_rejected": int,
    "num_demonstration_rows": int,
} | dict.fromkeys(("task", "difficulty", "origin", "recovery"), str)
"""Our columns of ``meta/episodes`` that every dataset of ours has, and the type of their values."""


def _size(root: Path, features: Mapping[str, Any], column: str) -> int:
    """How many numbers a row of a column has. Raises DatasetError unless its shape says so."""
    shape = features.get(column, {}).get("shape")
    if not isinstance(shape, list) or len(shape) != 1 or type(shape[0]) is not int or shape[0] < 1:
        raise DatasetError(f"{root / layout.INFO_PATH}: {column} has the shape {shape}; expected one number, its size")
    return shape[0]


def _side_px(root: Path, shapes: Mapping[str, Any]) -> int:
    """Side of the pictures of all cameras. Raises DatasetError unless there is one."""
    for camera, shape in shapes.items():
        is_square = isinstance(shape, list) and len(shape) == 3 and shape[0] == shape[1] and type(shape[0]) is int
        if not is_square or shape != next(iter(shapes.values())):
            raise DatasetError(
                f"{root / layout.INFO_PATH}: the video {layout.video_key(camera)} has the shape {shape}; expected "
                f"square pictures [px, px, 3], of one size in {' and '.join(map(layout.video_key, shapes))}"
            )
    return int(next(iter(shapes.values()))[0])


def _entry(root: Path, listed: dict[str, Any]) -> Entry:
    for name, kind in _LISTED.items():
        if not isinstance(listed.get(name), kind) or listed[name] == []:
            raise DatasetError(
                f"{root}: meta/episodes: expected {name} of type {kind.__name__}, came {listed.get(name)!r}"
            )
    if not 0 <= listed["num_demonstration_rows"] < listed["length"]:
        raise DatasetError(
            f"{root}: meta/episodes: {listed['num_demonstration_rows']} of {listed['length']} rows of episode "
            f"{listed['episode_index']} are a demonstration; some must follow"
        )
    return Entry(
        index=listed["episode_index"],
        instruction=listed["tasks"][0],
        num_rows=listed["length"],
        first_row=listed["dataset_from_index"],
        noise_rad=listed.get("noise_rad") or 0.0,
        corrected_from=listed.get("corrected_from") or 0,
        **{name: listed[name] for name in _SAME},
    )
