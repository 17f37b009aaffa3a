"""The files of a LeRobotDataset v3 folder, whatever its columns are: rows in parquet, joined videos, small tables.

Layout as lerobot 0.4.4 and 0.6.1 read it (`codebase_version` v3.0): many episodes share a file, ``meta/episodes`` says
where each lies. Nothing here depends on when or where it is written: equal episodes in equal order make equal bytes.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dual_system.data.statistics import Statistics, of_vectors
from dual_system.data.video import CODEC, PIXEL_FORMAT, VideoJoiner

VERSION = "v3.0"
FILES_PER_CHUNK = 1000
DATA_FILE_MB, VIDEO_FILE_MB = 100, 200
MIN_HZ, MAX_HZ = 0.01, 1000
"""Rates of a folder's rows that are read."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH, TASKS_PATH = "meta/episodes/chunk-000/file-000.parquet", "meta/tasks.parquet"
INFO_PATH, STATS_PATH = "meta/info.json", "meta/stats.json"
NUMBERING: dict[str, dict[str, Any]] = {
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    "frame_index": {"dtype": "int64", "shape": [1], "names": None},
    "episode_index": {"dtype": "int64", "shape": [1], "names": None},
    "index": {"dtype": "int64", "shape": [1], "names": None},
    "task_index": {"dtype": "int64", "shape": [1], "names": None},
}
"""LeRobot's own columns."""
DEMONSTRATION = "is_demonstration"


def video_key(camera: str) -> str:
    """LeRobot's name of a camera."""
    return f"observation.images.{camera}"


def numbered(num_rows: int, *, first_row: int, episode: int, task: int, fps: float) -> dict[str, pa.Array]:
    """The columns of `NUMBERING` for one episode."""
    return {
        "timestamp": pa.array((np.arange(num_rows) / fps).astype(np.float32)),
        "frame_index": pa.array(np.arange(num_rows)),
        "episode_index": pa.array(np.full(num_rows, episode)),
        "index": pa.array(np.arange(num_rows) + first_row),
        "task_index": pa.array(np.full(num_rows, task)),
    }


def video_feature(height_px: int, width_px: int, fps: int) -> dict[str, Any]:
    """LeRobot's description of a camera's videos."""
    return {
        "dtype": "video",
        "shape": [height_px, width_px, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.height": height_px,
            "video.width": width_px,
            "video.codec": CODEC,
            "video.pix_fmt": PIXEL_FORMAT,
            "video.is_depth_map": False,
            "video.fps": fps,
            "video.channels": 3,
            "has_audio": False,
        },
    }


def described(
    *,
    robot_type: str,
    fps: int,
    num_episodes: int,
    num_rows: int,
    num_tasks: int,
    limits_mb: tuple[int, int],
    features: dict[str, dict[str, Any]],
) -> dict[str, Any]:
    """Contents of ``meta/info.json``."""
    return {
        "codebase_version": VERSION,
        "robot_type": robot_type,
        "total_episodes": num_episodes,
        "total_frames": num_rows,
        "total_tasks": num_tasks,
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": limits_mb[0],
        "video_files_size_in_mb": limits_mb[1],
        "fps": fps,
        "splits": {"train": f"0:{num_episodes}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH,
        "features": features,
    }


class RowFiles:
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
            self._paths.append(made(self._root / DATA_PATH.format(**_place(len(self._paths)))))
            self._writer, self._num_bytes = pq.ParquetWriter(self._paths[-1], table.schema), 0
        self._writer.write_table(table, row_group_size=max(1, table.num_rows))
        self._num_bytes += table.nbytes
        return {f"data/{name}": value for name, value in _place(len(self._paths) - 1).items()}

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def statistics(self, own: Collection[str] = ()) -> dict[str, Statistics]:
        """Returns exact statistics over all rows as `of_columns`; it holds one column in memory at a time."""
        found = {}
        for name in number_columns(pq.read_schema(self._paths[0])):
            needed = {name, DEMONSTRATION} if name in own else {name}
            parts = [pq.read_table(path, columns=[*needed]) for path in self._paths]
            found[name] = of_columns(pa.concat_tables(parts), (name,), own)[name]
        return found


class VideoFiles:
    """The video files of one camera."""

    def __init__(self, root: Path, key: str, limit_mb: int, fps: int) -> None:
        self._root, self._key, self._limit_bytes, self._fps = root, key, limit_mb * 1_000_000, fps
        self._num_files = 0
        self._joiner: VideoJoiner | None = None

    def append(self, video: bytes, num_rows: int) -> dict[str, Any]:
        """Returns where the pictures lie. Raises ValueError unless there is one for each row."""
        if self._joiner is not None and self._joiner.num_bytes + len(video) > self._limit_bytes:
            self.close()
        if self._joiner is None:
            path = self._root / VIDEO_PATH.format(video_key=self._key, **_place(self._num_files))
            self._joiner = VideoJoiner(path, self._fps)
            self._num_files += 1
        begin = self._joiner.num_frames
        self._joiner.append(video)
        end = self._joiner.num_frames
        if end - begin != num_rows:
            raise ValueError(f"{self._key}: a video of {end - begin} frames for {num_rows} rows")
        placed: dict[str, Any] = dict(_place(self._num_files - 1))
        placed |= {"from_timestamp": begin / self._fps, "to_timestamp": end / self._fps}
        return {f"videos/{self._key}/{name}": value for name, value in placed.items()}

    def close(self) -> None:
        if self._joiner is not None:
            self._joiner.close()
            self._joiner = None


def _place(number: int) -> dict[str, int]:
    return {"chunk_index": number // FILES_PER_CHUNK, "file_index": number % FILES_PER_CHUNK}


def number_columns(schema: pa.Schema) -> list[str]:
    """Returns the names of the columns that have statistics."""
    kinds = {column.name: column.type for column in schema}
    return [name for name, kind in kinds.items() if not (pa.types.is_string(kind) or pa.types.is_list(kind))]


def of_columns(table: pa.Table, names: Sequence[str], own: Collection[str] = ()) -> dict[str, Statistics]:
    """Statistics of columns; those in ``own`` leave the rows of demonstrations out."""
    found = {}
    for name in names:
        column = table[name].combine_chunks()
        if pa.types.is_fixed_size_list(column.type):
            values = column.flatten().to_numpy().reshape(len(column), -1)
        else:
            values = column.to_numpy(zero_copy_only=False)
        found[name] = of_vectors(values[~table[DEMONSTRATION].to_numpy()] if name in own else values)
    return found


def tasks_table(instructions: Mapping[str, int]) -> pa.Table:
    """Instructions by number, as pandas stores a frame whose index they are: LeRobot looks them up through it."""
    table = pa.table({"task_index": pa.array(list(instructions.values())), "task": list(instructions)})
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_type, "metadata": None}
        for name, kind, numpy_type in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    index = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    return table.replace_schema_metadata({"pandas": json.dumps(index)})


def made(path: Path) -> Path:
    """Makes a file's folder. Returns the path, absolute: pyarrow takes "run:1" at its beginning for a URI's scheme."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path.absolute()


def write_json(path: Path, values: Any) -> None:
    path.write_text(json.dumps(values, indent=1) + "\n")
