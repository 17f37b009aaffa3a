"""Writes a dataset of ours as a LeRobotDataset v3 folder (`lerobot_files`): what `pp-train` reads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from dual_system.data import lerobot_files as layout
from dual_system.data.episode import EXECUTED, OPTIONAL, PANDA, TCP_POSE, Episode, RobotColumns, to_table
from dual_system.data.language import EVENTS, FEATURE, PERSISTENT, language_columns, spoken_in
from dual_system.data.lerobot_files import (
    DATA_FILE_MB,
    EPISODES_PATH,
    INFO_PATH,
    STATS_PATH,
    TASKS_PATH,
    VIDEO_FILE_MB,
    RowFiles,
    VideoFiles,
    video_key,
)
from dual_system.data.statistics import PixelHistogram
from dual_system.data.video import FPS

COLLECTION_PATH = "meta/collection.json"
"""Ours: how `pp-collect` made the folder."""

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
OUR_NAMES = {"observation.state": "state"}  # of LeRobot's columns; the others are called the same
_COLUMNS: dict[str, dict[str, Any]] = {
    "is_demonstration": {"dtype": "bool", "shape": [1], "names": None},
    "is_transition": {"dtype": "bool", "shape": [1], "names": None},
    "is_rendered": {"dtype": "bool", "shape": [1], "names": None},
    "subgoal": {"dtype": "string", "shape": [1], "names": None},
    "grounded_subgoal": {"dtype": "string", "shape": [1], "names": None},
    "demonstration_reasoning": {"dtype": "string", "shape": [1], "names": None},
    **layout.NUMBERING,
}
_POLICY = ("observation.state", "action", TCP_POSE, EXECUTED)
"""Columns whose statistics leave demonstrations out: they normalise the policy."""


class DatasetWriter:
    """Appends episodes to a new v3 folder; `finish` writes its tables, without which it is no dataset yet."""

    def __init__(
        self,
        root: Path,
        robot: RobotColumns = PANDA,
        *,
        data_file_mb: int = DATA_FILE_MB,
        video_file_mb: int = VIDEO_FILE_MB,
    ) -> None:
        self._root, self._robot = root, robot
        self._limits_mb = (data_file_mb, video_file_mb)
        self._data = RowFiles(root, data_file_mb)
        self._videos = {camera: VideoFiles(root, video_key(camera), video_file_mb, FPS) for camera in robot.videos}
        self._pixels = {camera: PixelHistogram() for camera in robot.videos}
        self._instructions: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._image_px = 0
        self._num_rows = 0
        self._optional: tuple[str, ...] | None = None

    def add(self, episode: Episode) -> None:
        """Appends an episode."""
        about, num_rows = episode.about, len(episode.rows)
        self._image_px = self._image_px or about.image_px
        if about.image_px != self._image_px:
            raise ValueError(
                f"episode of {about.image_px} px after ones of {self._image_px} px; a dataset has one size"
            )
        optional = tuple(name for name in OPTIONAL if getattr(episode.rows, name) is not None)
        if self._optional not in (None, optional):
            (differs, *_) = {*self._optional} ^ {*optional}
            raise ValueError(f"a dataset's episodes all have {differs}, or none has; {about.task} {about.seed} differs")
        self._optional = optional
        table = self._numbered(episode)
        placed: dict[str, Any] = {
            "episode_index": len(self._episodes),
            "tasks": [about.instruction],
            "length": num_rows,
            "dataset_from_index": self._num_rows,
            "dataset_to_index": self._num_rows + num_rows,
            "task": about.task,
            "seed": about.seed,
            "difficulty": about.difficulty,
            "origin": about.origin,
            "is_success": about.is_success,
            "recovery": about.recovery,
            "num_rejected": len(about.rejected),
            "num_demonstration_rows": int(episode.rows.is_demonstration.sum()),
            "corrected_from": about.corrected_from,
        }
        if EXECUTED in optional:
            placed["noise_rad"] = about.noise_rad
        placed |= self._data.append(table)
        for camera, videos in self._videos.items():
            placed |= videos.append(episode.videos[camera], num_rows)
            self._pixels[camera] = self._pixels[camera] + episode.pixels[camera]
        statistics = layout.of_columns(table, layout.number_columns(table.schema), _POLICY)
        statistics |= {video_key(camera): pixels.statistics() for camera, pixels in episode.pixels.items()}
        placed |= {f"stats/{name}/{key}": value for name, of in statistics.items() for key, value in of.items()}
        placed |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        self._episodes.append(placed)
        self._num_rows += num_rows

    def finish(self) -> None:
        """Closes the files and writes the tables. Raises ValueError if there is no episode."""
        if not self._episodes:
            raise ValueError("a dataset needs at least one episode")
        self._data.close()
        for videos in self._videos.values():
            videos.close()
        pq.write_table(pa.Table.from_pylist(self._episodes), layout.made(self._root / EPISODES_PATH))
        pq.write_table(layout.tasks_table(self._instructions), layout.made(self._root / TASKS_PATH))
        statistics = self._data.statistics(_POLICY)
        statistics |= {video_key(camera): pixels.statistics() for camera, pixels in self._pixels.items()}
        layout.write_json(self._root / STATS_PATH, statistics)
        layout.write_json(self._root / INFO_PATH, self._described())

    def _numbered(self, episode: Episode) -> pa.Table:
        """The rows under LeRobot's names, with the numbers it counts by."""
        rows, num_rows = to_table(episode.rows), len(episode.rows)
        task_index = self._instructions.setdefault(episode.about.instruction, len(self._instructions))
        named = {name: OUR_NAMES.get(name, name) for name in self._columns()}
        columns = {name: rows[ours] for name, ours in named.items() if ours in rows.column_names}
        columns |= layout.numbered(
            num_rows, first_row=self._num_rows, episode=len(self._episodes), task=task_index, fps=FPS
        )
        return pa.table(columns | language_columns(spoken_in(episode.rows), num_rows))

    def _columns(self) -> dict[str, dict[str, Any]]:
        robot, optional = self._robot, self._optional or ()
        vectors = {"observation.state": robot.state, "action": robot.action}
        vectors |= {TCP_POSE: _POSE} if TCP_POSE in optional else {}
        found = {name: _vectors(names) for name, names in vectors.items()} | _COLUMNS
        return found | ({EXECUTED: _vectors(robot.action)} if EXECUTED in optional else {})

    def _described(self) -> dict[str, Any]:
        video = layout.video_feature(self._image_px, self._image_px, FPS)
        return layout.described(
            robot_type=self._robot.robot_type,
            fps=FPS,
            num_episodes=len(self._episodes),
            num_rows=self._num_rows,
            num_tasks=len(self._instructions),
            limits_mb=self._limits_mb,
            features={
                **self._columns(),
                PERSISTENT: FEATURE,
                EVENTS: FEATURE,
                **{video_key(camera): video for camera in self._robot.videos},
            },
        )


def _vectors(names: Sequence[str]) -> dict[str, Any]:
    """LeRobot's description of a column whose rows have one number for each name."""
    return {"dtype": "float32", "shape": [len(names)], "names": list(names)}
