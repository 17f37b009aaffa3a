"""Episodes of any robot as they were recorded, in a LeRobotDataset v3 folder at the robot's own rate.

Row k holds what was seen at tick k and what was then commanded. Nothing is resampled and nothing added: a tick without
an observation or a picture repeats the last one, and says so (``is_rendered``). Not what `pp-train` reads;
`pp-collect import` makes that of it, where the robot is the Panda.
"""

# N rows, P numbers of the state, A of the command

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dual_system.data import lerobot_files as layout
from dual_system.data.errors import DatasetError
from dual_system.data.language import EVENTS, FEATURE, PERSISTENT, language_columns
from dual_system.data.statistics import PixelHistogram
from dual_system.data.video import Frame, VideoWriter
from protocol import messages as m

STATE, ACTION, LEVEL, RENDERED = "observation.state", "action", "level", "is_rendered"


class Seen(NamedTuple):
    """A camera's picture (height, width, 3) in a row."""

    camera: str
    row: int
    frame: Frame


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """An episode. ``robot`` names its numbers and cameras."""

    name: str
    """Where it is from, for errors."""
    robot: m.Robot
    control_hz: int
    instruction: str
    state_NP: m.Floats
    action_NA: m.Floats
    level: tuple[str, ...]
    """Rung of the ladder of each row in small letters; "play" where there is no ladder."""
    spoken: list[dict[str, Any]]
    """LeRobot's persistent language (`language.said`)."""
    seen: Iterable[Seen]
    """Every camera's pictures; the rows of each ascend."""
    about: Mapping[str, Any]
    """Further columns of ``meta/episodes``."""


class RecordingWriter:
    """Appends recordings of one robot to a new v3 folder; `finish` writes its tables, without which it is none yet."""

    def __init__(self, root: Path, *, data_file_mb: int = layout.DATA_FILE_MB) -> None:
        self._root, self._data_file_mb = root, data_file_mb
        self._data = layout.RowFiles(root, data_file_mb)
        self._videos: dict[str, layout.VideoFiles] = {}
        self._pixels: dict[str, PixelHistogram] = {}
        self._features: dict[str, Any] = {}
        self._robot_type, self._fps, self._num_rows = "", 0, 0
        self._instructions: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []

    def add(self, recording: Recording) -> None:
        """Appends an episode.

        Raises DatasetError if it is of another robot, rate or picture size than the first, or a camera's first picture
        is missing.
        """
        num_rows, fps, robot = len(recording.state_NP), recording.control_hz, recording.robot
        films = {camera: _Film(recording.name, camera, fps) for camera in robot.cameras}
        for camera, row, frame in recording.seen:
            films[camera].show(row, frame)
        videos = {camera: film.finish(num_rows) for camera, film in films.items()}
        self._settle(recording, {camera: film.size_px for camera, film in films.items()})
        is_rendered = np.ones(num_rows, np.bool_)
        for film in films.values():
            is_rendered &= np.isin(np.arange(num_rows), film.rows)
        task = self._instructions.setdefault(recording.instruction, len(self._instructions))
        counted = layout.numbered(num_rows, first_row=self._num_rows, episode=len(self._episodes), task=task, fps=fps)
        columns: dict[str, Any] = {
            STATE: _lists(recording.state_NP),
            ACTION: _lists(recording.action_NA),
            LEVEL: pa.array(recording.level, pa.string()),
            RENDERED: pa.array(is_rendered),
        }
        table = pa.table(columns | counted | language_columns(recording.spoken, num_rows))
        placed: dict[str, Any] = {
            "episode_index": len(self._episodes),
            "tasks": [recording.instruction],
            "length": num_rows,
            "dataset_from_index": self._num_rows,
            "dataset_to_index": self._num_rows + num_rows,
            **recording.about,
            **self._data.append(table),
        }
        statistics = layout.of_columns(table, layout.number_columns(table.schema))
        for camera, video in videos.items():
            placed |= self._videos[camera].append(video, num_rows)
            self._pixels[camera] = self._pixels[camera] + films[camera].pixels
            statistics[layout.video_key(camera)] = films[camera].pixels.statistics()
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
        pq.write_table(pa.Table.from_pylist(self._episodes), layout.made(self._root / layout.EPISODES_PATH))
        pq.write_table(layout.tasks_table(self._instructions), layout.made(self._root / layout.TASKS_PATH))
        statistics = self._data.statistics()
        statistics |= {layout.video_key(camera): pixels.statistics() for camera, pixels in self._pixels.items()}
        layout.write_json(self._root / layout.STATS_PATH, statistics)
        described = layout.described(
            robot_type=self._robot_type,
            fps=self._fps,
            num_episodes=len(self._episodes),
            num_rows=self._num_rows,
            num_tasks=len(self._instructions),
            limits_mb=(self._data_file_mb, layout.VIDEO_FILE_MB),
            features=self._features,
        )
        layout.write_json(self._root / layout.INFO_PATH, described)

    def _settle(self, recording: Recording, sizes_px: Mapping[str, tuple[int, int]]) -> None:
        """The first episode decides what a row has; raises DatasetError if a later one differs."""
        robot, fps = recording.robot, recording.control_hz
        features = {
            STATE: {"dtype": "float32", "shape": [robot.num_proprio], "names": state_names(robot)},
            ACTION: {"dtype": "float32", "shape": [robot.action_dim], "names": action_names(robot)},
            LEVEL: {"dtype": "string", "shape": [1], "names": None},
            RENDERED: {"dtype": "bool", "shape": [1], "names": None},
            **layout.NUMBERING,
            PERSISTENT: FEATURE,
            EVENTS: FEATURE,
            **{layout.video_key(camera): layout.video_feature(*size, fps) for camera, size in sizes_px.items()},
        }
        if not self._features:
            self._features, self._robot_type, self._fps = features, robot.name, fps
            self._videos = {
                camera: layout.VideoFiles(self._root, layout.video_key(camera), layout.VIDEO_FILE_MB, fps)
                for camera in robot.cameras
            }
            self._pixels = {camera: PixelHistogram() for camera in robot.cameras}
        for what, first, now in (
            ("robot", self._robot_type, robot.name),
            ("rate in Hz", self._fps, fps),
            ("cameras", sorted(self._videos), sorted(robot.cameras)),
            *((name, self._features.get(name), feature) for name, feature in features.items()),
        ):
            if first != now:
                raise DatasetError(
                    f"{recording.name}: {what}: expected {_short(first)} as in the first episode, came {_short(now)}; "
                    "a dataset is of one robot, so give the others another --out"
                )


def state_names(robot: m.Robot) -> list[str]:
    """Names of the numbers of a robot's state: of the dimensions whose state they are, or by place."""
    names = {each.state_index: each.name for each in robot.dimensions if each.state_index is not None}
    return [names.get(place, f"state_{place}") for place in range(robot.num_proprio)]


def action_names(robot: m.Robot) -> list[str]:
    """Names of the numbers of a robot's commands."""
    return [each.name for each in robot.dimensions] or [f"action_{place}" for place in range(robot.action_dim)]


class _Film:
    """One camera's video of one episode, made as its pictures come."""

    def __init__(self, name: str, camera: str, fps: int) -> None:
        self._name, self._camera, self._fps = name, camera, fps
        self._writer: VideoWriter | None = None
        self._num_frames = 0
        self._counted_row = -fps
        self.size_px = (0, 0)
        self.rows: list[int] = []
        self.pixels = PixelHistogram()

    def show(self, row: int, frame: Frame) -> None:
        size_px = (frame.shape[0], frame.shape[1])
        if self._writer is None:
            self._begin(row, size_px)
        if size_px != self.size_px:
            raise self._error(f"its picture in row {row} has {size_px} px, those before have {self.size_px} px")
        if row < self._num_frames:
            raise self._error(f"its picture of row {row} comes after that of row {self._num_frames - 1}")
        self._repeat(row)
        self._add(frame)
        self.rows.append(row)
        if row - self._counted_row >= self._fps:  # one a second is enough for statistics
            self.pixels.add(frame)
            self._counted_row = row

    def finish(self, num_rows: int) -> bytes:
        if self._writer is None:
            raise self._error("it has no picture")
        self._repeat(num_rows)
        return self._writer.finish()

    def _begin(self, row: int, size_px: tuple[int, int]) -> None:
        if row:
            raise self._error(f"its first picture is of row {row}, and row 0 has none")
        if size_px[0] % 2 or size_px[1] % 2:
            raise self._error(f"its pictures have {size_px[0]} x {size_px[1]} px, and H.264 has even sizes only")
        self.size_px, self._writer = size_px, VideoWriter(*size_px, self._fps)

    def _repeat(self, until: int) -> None:
        while self._num_frames < until:
            self._add(None)

    def _add(self, frame: Frame | None) -> None:
        assert self._writer is not None
        self._writer.add(frame)
        self._num_frames += 1

    def _error(self, what: str) -> DatasetError:
        return DatasetError(f"{self._name}: camera {self._camera}: {what}")


def _lists(values: NDArray[np.float32]) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])


def _short(value: Any) -> str:
    picked = {key: value.get(key) for key in ("shape", "names")} if isinstance(value, dict) else value
    return f"{picked}" if not isinstance(picked, Sequence) or isinstance(picked, str) else ", ".join(map(str, picked))
