"""One episode on disk: rows at 20 Hz, a video per camera, and a description of the whole; its writer and its reader.

Row k holds what was seen *before* action k: state, pictures and texts of one instant, and the action that was then
applied. A demonstration's rows come first; their ``action`` is the command in force when the picture was taken. An
episode is a handful of files in memory (`Package`): any worker makes it, and one committer writes it to disk.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dual_system.data.statistics import PixelHistogram
from dual_system.data.video import FPS, Frame, VideoWriter

CAMERAS = ("front", "wrist")
ROWS, ABOUT = "rows.parquet", "episode.json"
EXECUTED = "executed_action"
OPTIONAL = (EXECUTED,)
"""Columns that only some datasets have: those collected under noise."""

_TYPES = {
    **{
        name: pa.list_(pa.float32(), size)
        for name, size in (("state", 8), ("action", 8), ("tcp_pose", 7), (EXECUTED, 8))
    },
    **dict.fromkeys(("is_demonstration", "is_transition", "is_rendered"), pa.bool_()),
}
"""Arrow types of the columns; the others are texts."""

Package = dict[str, bytes]  # file name -> content
Recovery = Literal["none", "z", "xy"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Row:
    """One instant of an episode and what was done then."""

    state: NDArray[np.float32]  # (8,): seven joints [rad], one finger's opening [m]
    action: NDArray[np.float32]  # (8,): seven joint targets [rad], gripper in [-1, 1]
    tcp_pose: NDArray[np.float32]  # (7,): xyz [m], quaternion wxyz, of the joints in `state`
    subgoal: str
    grounded_subgoal: str
    is_demonstration: bool = False
    is_transition: bool = False  # the first row of a new subgoal that the robot itself is to reach
    demonstration_reasoning: str = ""  # only in the first row after a demonstration
    executed_action: NDArray[np.float32] | None = None  # (8,): executed in place of `action`, under noise


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejection:
    """A seed whose episode was not kept."""

    seed: int
    reason: str
    noise_rad: float = 0.0  # as in `About`


IMPORTED = "import"
"""Origin of episodes that others recorded; their task and seed are theirs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class About:
    """The description of a whole episode."""

    task: str
    instruction: str
    seed: int
    difficulty: str
    origin: str  # "oracle", the policy that was recorded, or IMPORTED
    is_success: bool
    image_px: int
    recovery: Recovery = "none"  # where a grasp was made to fail before the right one
    rejected: tuple[Rejection, ...] = ()
    noise_rad: float = 0.0  # standard deviation of the joint targets' noise, far from everything; see `dart`
    corrected_from: int = 0  # the first row after the demonstration that POUNCE imitates; see `correct`


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """The rows of an episode as columns."""

    state: NDArray[np.float32]  # (N, 8)
    action: NDArray[np.float32]  # (N, 8)
    tcp_pose: NDArray[np.float32]  # (N, 7)
    is_demonstration: NDArray[np.bool_]  # (N,)
    is_transition: NDArray[np.bool_]  # (N,)
    is_rendered: NDArray[np.bool_]  # (N,): the pictures are this row's own, not repeats of an earlier row's
    subgoal: tuple[str, ...]
    grounded_subgoal: tuple[str, ...]
    demonstration_reasoning: tuple[str, ...]
    executed_action: NDArray[np.float32] | None = None  # (N, 8); None: every action was executed as it is

    def __len__(self) -> int:
        return len(self.state)


class EpisodeWriter:
    """Takes an episode row by row and encodes its pictures as they come; it needs some megabytes of memory."""

    def __init__(self, image_px: int) -> None:
        self._rows: list[Row] = []
        self._is_rendered: list[bool] = []
        self._videos = {camera: VideoWriter(image_px) for camera in CAMERAS}
        self._pixels = {camera: PixelHistogram() for camera in CAMERAS}
        self._counted_row = -FPS

    def add(self, row: Row, frames: Mapping[str, Frame]) -> None:
        """Appends a row with the pictures of both cameras, or none: then the videos repeat the last ones."""
        counts = bool(frames) and len(self._rows) - self._counted_row >= FPS  # one a second is enough for statistics
        for camera in CAMERAS:
            self._videos[camera].add(frames.get(camera))
            if counts:
                self._pixels[camera].add(frames[camera])
        self._counted_row = len(self._rows) if counts else self._counted_row
        self._rows.append(row)
        self._is_rendered.append(bool(frames))

    def pack(self, about: About) -> Package:
        """Returns the files of the finished episode."""
        rows = self._rows
        columns = Rows(
            **{name: np.stack([getattr(row, name) for row in rows]) for name in ("state", "action", "tcp_pose")},
            is_demonstration=np.array([row.is_demonstration for row in rows]),
            is_transition=np.array([row.is_transition for row in rows]),
            is_rendered=np.array(self._is_rendered),
            subgoal=tuple(row.subgoal for row in rows),
            grounded_subgoal=tuple(row.grounded_subgoal for row in rows),
            demonstration_reasoning=tuple(row.demonstration_reasoning for row in rows),
            executed_action=_executed(rows),
        )
        pixels = {camera: [each.num_frames, each.counts.tolist()] for camera, each in self._pixels.items()}
        sink = io.BytesIO()
        pq.write_table(to_table(columns), sink)
        return {
            ROWS: sink.getvalue(),
            ABOUT: (json.dumps({**asdict(about), "pixels": pixels}) + "\n").encode(),
            **{f"{camera}.mp4": video.finish() for camera, video in self._videos.items()},
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Episode:
    """A package that was read."""

    about: About
    rows: Rows
    pixels: Mapping[str, PixelHistogram]
    videos: Mapping[str, bytes]


def unpack(package: Package) -> Episode:
    """Reads what `EpisodeWriter.pack` made."""
    values = json.loads(package[ABOUT])
    pixels = {
        camera: PixelHistogram(np.array(counts, np.int64), num_frames)
        for camera, (num_frames, counts) in values.pop("pixels").items()
    }
    values["rejected"] = tuple(Rejection(**each) for each in values["rejected"])
    return Episode(
        about=About(**values),
        rows=from_table(pq.read_table(io.BytesIO(package[ROWS]))),
        pixels=pixels,
        videos={camera: package[f"{camera}.mp4"] for camera in CAMERAS},
    )


def to_table(rows: Rows) -> pa.Table:
    """Returns the rows as an Arrow table."""
    columns = {each.name: getattr(rows, each.name) for each in fields(Rows)}
    return pa.table({name: _to_arrow(column) for name, column in columns.items() if column is not None})


def from_table(table: pa.Table) -> Rows:
    """Returns the rows of an Arrow table; unknown columns are ignored, and optional ones may be missing.

    Raises:
        ValueError: a column cannot be of its type in `Rows`, or a value is null. Other widths are cast: pandas, with
            which LeRobot's tools rewrite rows, has its own.
    """
    names = [each.name for each in fields(Rows) if each.name not in OPTIONAL or each.name in table.column_names]
    return Rows(**{name: _from_arrow(name, table.column(name).combine_chunks()) for name in names})


def _executed(rows: list[Row]) -> NDArray[np.float32] | None:
    """Returns the executed actions (N, 8); None if no row has one."""
    if all(row.executed_action is None for row in rows):
        return None
    return np.stack([row.action if row.executed_action is None else row.executed_action for row in rows])


def _to_arrow(column: Any) -> Any:
    if isinstance(column, tuple):
        return pa.array(column, pa.string())
    if column.ndim == 1:
        return pa.array(column)
    return pa.FixedSizeListArray.from_arrays(pa.array(column.reshape(-1)), column.shape[1])


def _from_arrow(name: str, column: Any) -> Any:
    kind = _TYPES.get(name, pa.string())
    try:
        column = column.cast(kind)
    except pa.ArrowException as error:
        raise ValueError(f"column {name} has the type {column.type}, expected {kind}: {error}") from None
    if column.null_count or (pa.types.is_nested(kind) and column.flatten().null_count):
        raise ValueError(f"column {name} has values that are null")
    if pa.types.is_string(kind):
        return tuple(column.to_pylist())
    if pa.types.is_nested(kind):
        return column.flatten().to_numpy().reshape(len(column), kind.list_size)
    return column.to_numpy(zero_copy_only=False)
