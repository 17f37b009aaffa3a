"""Writes a LeRobotDataset v3 folder: parquet rows, joined videos, and the tables that locate episodes.

Layout as lerobot 0.4.4 reads it (`codebase_version` v3.0): many episodes share a file, ``meta/episodes`` says where
each lies. Nothing here depends on when or where it is written: equal episodes in equal order make equal bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dual_system.data.episode import CAMERAS, EXECUTED, OPTIONAL, Episode, to_table
from dual_system.data.language import EVENTS, FEATURE, PERSISTENT, language_columns
from dual_system.data.statistics import PixelHistogram, Statistics, of_vectors
from dual_system.data.video import CODEC, FPS, PIXEL_FORMAT, VideoJoiner

VERSION = "v3.0"
FILES_PER_CHUNK = 1000
DATA_FILE_MB, VIDEO_FILE_MB = 100, 200
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH, TASKS_PATH = "meta/episodes/chunk-000/file-000.parquet", "meta/tasks.parquet"
INFO_PATH, STATS_PATH = "meta/info.json", "meta/stats.json"
COLLECTION_PATH = "meta/collection.json"
"""Ours: how `pp-collect` made the folder."""

_JOINTS = [f"joint_{number}" for number in range(1, 8)]
_POSE = ["x", "y", "z", "qw", "qx", "qy", "qz"]
OUR_NAMES = {"observation.state": "state"}  # of LeRobot's columns; the others are called the same
_COLUMNS: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": [8], "names": [*_JOINTS, "finger_opening"]},
    "action": {"dtype": "float32", "shape": [8], "names": [*_JOINTS, "gripper"]},
    "tcp_pose": {"dtype": "float32", "shape": [7], "names": _POSE},
    "is_demonstration": {"dtype": "bool", "shape": [1], "names": None},
    "is_transition": {"dtype": "bool", "shape": [1], "names": None},
    "is_rendered": {"dtype": "bool", "shape": [1], "names": None},
    "subgoal": {"dtype": "string", "shape": [1], "names": None},
    "grounded_subgoal": {"dtype": "string", "shape": [1], "names": None},
    "demonstration_reasoning": {"dtype": "string", "shape": [1], "names": None},
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    "frame_index": {"dtype": "int64", "shape": [1], "names": None},
    "episode_index": {"dtype": "int64", "shape": [1], "names": None},
    "index": {"dtype": "int64", "shape": [1], "names": None},
    "task_index": {"dtype": "int64", "shape": [1], "names": None},
}
_OPTIONAL_COLUMNS = {EXECUTED: _COLUMNS["action"]}
"""Columns that only some datasets have (`episode.OPTIONAL`)."""
_POLICY = ("observation.state", "action", "tcp_pose", EXECUTED)
"""Columns whose statistics leave demonstrations out: they normalise the policy."""


def video_key(camera: str) -> str:
    """LeRobot's name of a camera."""
    return f"observation.images.{camera}"


class DatasetWriter:
    """Appends episodes to a new v3 folder; `finish` writes its tables, without which it is no dataset yet."""

    def __init__(self, root: Path, *, data_file_mb: int = DATA_FILE_MB, video_file_mb: int = VIDEO_FILE_MB) -> None:
        self._root = root
        self._limits_mb = (data_file_mb, video_file_mb)
        self._data = _Rows(root, data_file_mb)
        self._videos = {camera: _Videos(root, video_key(camera), video_file_mb) for camera in CAMERAS}
        self._pixels = {camera: PixelHistogram() for camera in CAMERAS}
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
        statistics = _of_columns(table, _numbers(table.schema))
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
        pq.write_table(pa.Table.from_pylist(self._episodes), _made(self._root / EPISODES_PATH))
        pq.write_table(_tasks(self._instructions), self._root / TASKS_PATH)
        statistics = self._data.statistics()
        statistics |= {video_key(camera): pixels.statistics() for camera, pixels in self._pixels.items()}
        _write_json(self._root / STATS_PATH, statistics)
        _write_json(self._root / INFO_PATH, self._described())

    def _numbered(self, episode: Episode) -> pa.Table:
        """The rows under LeRobot's names, with the numbers it counts by."""
        rows, num_rows = to_table(episode.rows), len(episode.rows)
        task_index = self._instructions.setdefault(episode.about.instruction, len(self._instructions))
        named = {name: OUR_NAMES.get(name, name) for name in self._columns()}
        columns = {name: rows[ours] for name, ours in named.items() if ours in rows.column_names}
        columns["timestamp"] = pa.array((np.arange(num_rows) / FPS).astype(np.float32))
        columns["frame_index"] = pa.array(np.arange(num_rows))
        columns["episode_index"] = pa.array(np.full(num_rows, len(self._episodes)))
        columns["index"] = pa.array(np.arange(num_rows) + self._num_rows)
        columns["task_index"] = pa.array(np.full(num_rows, task_index))
        return pa.table(columns | language_columns(episode.rows))

    def _columns(self) -> dict[str, dict[str, Any]]:
        return _COLUMNS | {name: _OPTIONAL_COLUMNS[name] for name in self._optional or ()}

    def _described(self) -> dict[str, Any]:
        video = {
            "dtype": "video",
            "shape": [self._image_px, self._image_px, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": self._image_px,
                "video.width": self._image_px,
                "video.codec": CODEC,
                "video.pix_fmt": PIXEL_FORMAT,
                "video.is_depth_map": False,
                "video.fps": FPS,
                "video.channels": 3,
                "has_audio": False,
            },
        }
        return {
            "codebase_version": VERSION,
            "robot_type": "panda",
            "total_episodes": len(self._episodes),
            "total_frames": self._num_rows,
            "total_tasks": len(self._instructions),
            "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": self._limits_mb[0],
            "video_files_size_in_mb": self._limits_mb[1],
            "fps": FPS,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH,
            "features": {
                **self._columns(),
                PERSISTENT: FEATURE,
                EVENTS: FEATURE,
                **{video_key(camera): video for camera in CAMERAS},
            },
        }


class _Rows:
    """The parquet files of all rows; an episode is one row group, so that it can be read alone."""

    def __init__(self, root: Path, limit_mb: int) -> None:
        self._root, self._limit_bytes = root, limit_mb * 1_000_000
        self._paths: list[Path] = []
        self._writer: pq.ParquetWriter | None = None
        self._num_bytes = 0

    def append(self, table: pa.Table) -> dict[str, int]:
        """Returns where the rows lie. Sizes are counted before compression, so files stay below the limit."""
        if self._writer is not None and self._num_bytes + table.nbytes > self._limit_bytes:
            self.close()
        if self._writer is None:
            self._paths.append(_made(self._root / DATA_PATH.format(**_place(len(self._paths)))))
            self._writer, self._num_bytes = pq.ParquetWriter(self._paths[-1], table.schema), 0
        self._writer.write_table(table, row_group_size=max(1, table.num_rows))
        self._num_bytes += table.nbytes
        return {f"data/{name}": value for name, value in _place(len(self._paths) - 1).items()}

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def statistics(self) -> dict[str, Statistics]:
        """Returns exact statistics over all rows; it holds one column in memory at a time."""
        found = {}
        for name in _numbers(pq.read_schema(self._paths[0])):
            parts = [pq.read_table(path, columns=[*{name, "is_demonstration"}]) for path in self._paths]
            found[name] = _of_columns(pa.concat_tables(parts), names=(name,))[name]
        return found


class _Videos:
    """The video files of one camera."""

    def __init__(self, root: Path, key: str, limit_mb: int) -> None:
        self._root, self._key, self._limit_bytes = root, key, limit_mb * 1_000_000
        self._num_files = 0
        self._joiner: VideoJoiner | None = None

    def append(self, video: bytes, num_rows: int) -> dict[str, Any]:
        """Returns where the pictures lie. Raises ValueError unless there is one for each row."""
        if self._joiner is not None and self._joiner.num_bytes + len(video) > self._limit_bytes:
            self.close()
        if self._joiner is None:
            path = self._root / VIDEO_PATH.format(video_key=self._key, **_place(self._num_files))
            self._joiner = VideoJoiner(path)
            self._num_files += 1
        begin = self._joiner.num_frames
        self._joiner.append(video)
        end = self._joiner.num_frames
        if end - begin != num_rows:
            raise ValueError(f"{self._key}: a video of {end - begin} frames for {num_rows} rows")
        placed: dict[str, Any] = dict(_place(self._num_files - 1))
        placed |= {"from_timestamp": begin / FPS, "to_timestamp": end / FPS}
        return {f"videos/{self._key}/{name}": value for name, value in placed.items()}

    def close(self) -> None:
        if self._joiner is not None:
            self._joiner.close()
            self._joiner = None


def _place(number: int) -> dict[str, int]:
    return {"chunk_index": number // FILES_PER_CHUNK, "file_index": number % FILES_PER_CHUNK}


def _numbers(schema: pa.Schema) -> list[str]:
    """Returns the names of the columns that have statistics."""
    kinds = {column.name: column.type for column in schema}
    return [name for name, kind in kinds.items() if not (pa.types.is_string(kind) or pa.types.is_list(kind))]


def _of_columns(table: pa.Table, names: Sequence[str]) -> dict[str, Statistics]:
    is_own = ~table["is_demonstration"].to_numpy()
    found = {}
    for name in names:
        column = table[name].combine_chunks()
        if pa.types.is_fixed_size_list(column.type):
            values = column.flatten().to_numpy().reshape(len(column), -1)
        else:
            values = column.to_numpy(zero_copy_only=False)
        found[name] = of_vectors(values[is_own] if name in _POLICY else values)
    return found


def _tasks(instructions: Mapping[str, int]) -> pa.Table:
    """Instructions by number, as pandas stores a frame whose index they are: LeRobot looks them up through it."""
    table = pa.table({"task_index": pa.array(list(instructions.values())), "task": list(instructions)})
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_type, "metadata": None}
        for name, kind, numpy_type in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    index = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    return table.replace_schema_metadata({"pandas": json.dumps(index)})


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _write_json(path: Path, values: Any) -> None:
    path.write_text(json.dumps(values, indent=1) + "\n")
