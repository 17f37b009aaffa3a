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
DEMO_CAMERA = "demonstration"
"""Camera of demonstrations by another body: a dataset that has it shows them with it alone."""
ROWS, ABOUT = "rows.parquet", "episode.json"
EXECUTED, TCP_POSE = "executed_action", "tcp_pose"
OPTIONAL = (TCP_POSE, EXECUTED)
"""Columns that only some datasets have: those of our arm, and those collected under noise."""

_VECTORS = ("state", "action", *OPTIONAL)
_TRUTHS = ("is_demonstration", "is_transition", "is_rendered")

Package = dict[str, bytes]  # file name -> content
Recovery = Literal["none", "z", "xy"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotColumns:
    """The robot whose episodes a dataset holds: names of its numbers, and its cameras in the models' order."""

    robot_type: str
    state: tuple[str, ...]
    action: tuple[str, ...]
    cameras: tuple[str, ...]
    has_demo_camera: bool = False
    """Demonstrations are by another body, in `DEMO_CAMERA` alone."""

    @property
    def videos(self) -> tuple[str, ...]:
        return (*self.cameras, DEMO_CAMERA) if self.has_demo_camera else self.cameras

    def shown_in(self, is_demonstration: bool) -> tuple[str, ...]:
        """The cameras whose pictures a row of its own has."""
        return (DEMO_CAMERA,) if is_demonstration and self.has_demo_camera else self.cameras


_JOINTS = tuple(f"joint_{number}" for number in range(1, 8))
PANDA = RobotColumns(
    robot_type="panda", state=(*_JOINTS, "finger_opening"), action=(*_JOINTS, "gripper"), cameras=CAMERAS
)
"""The arm of the sixteen tasks: seven joints [rad] and one finger's opening [m]; joint targets, gripper in [-1, 1]."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Row:
    """One instant of an episode and what was done then. S and A are the robot's (`RobotColumns`)."""

    state: NDArray[np.float32]  # (S,)
    action: NDArray[np.float32]  # (A,)
    tcp_pose: NDArray[np.float32] | None = None  # (7,): xyz [m], quaternion wxyz, of the joints in `state`
    subgoal: str
    grounded_subgoal: str
    is_demonstration: bool = False
    is_transition: bool = False  # the first row of a new subgoal that the robot itself is to reach
    demonstration_reasoning: str = ""  # only in the first row after a demonstration
    executed_action: NDArray[np.float32] | None = None  # (A,): executed in place of `action`, under noise


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

    state: NDArray[np.float32]  # (N, S)
    action: NDArray[np.float32]  # (N, A)
    is_demonstration: NDArray[np.bool_]  # (N,)
    is_transition: NDArray[np.bool_]  # (N,)
    is_rendered: NDArray[np.bool_]  # (N,): the pictures are this row's own, not repeats of an earlier row's
    subgoal: tuple[str, ...]
    grounded_subgoal: tuple[str, ...]
    demonstration_reasoning: tuple[str, ...]
    tcp_pose: NDArray[np.float32] | None = None  # (N, 7); None: not recorded
    executed_action: NDArray[np.float32] | None = None  # (N, A); None: every action was executed as it is

    def __len__(self) -> int:
        return len(self.state)


class EpisodeWriter:
    """Takes an episode row by row and encodes its pictures as they come; it needs some megabytes of memory."""

    def __init__(self, image_px: int, robot: RobotColumns = PANDA) -> None:
        self._robot = robot
        self._rows: list[Row] = []
        self._is_rendered: list[bool] = []
        self._videos = {camera: VideoWriter(image_px) for camera in robot.videos}
        self._pixels = {camera: PixelHistogram() for camera in robot.videos}
        self._counted_row = -FPS
        if robot.has_demo_camera:  # no row has a picture of every camera: what comes before a camera's first is black
            self._before: Frame | None = np.zeros((image_px, image_px, 3), np.uint8)
        else:
            self._before = None

    def add(self, row: Row, frames: Mapping[str, Frame]) -> None:
        """Appends a row with its cameras' pictures (`RobotColumns.shown_in`), or none: the videos repeat the last ones.

        Raises:
            ValueError: the numbers are not the robot's, or the pictures are of other cameras.
        """
        robot, shown = self._robot, self._robot.shown_in(row.is_demonstration)
        if (len(row.state), len(row.action)) != (len(robot.state), len(robot.action)):
            raise ValueError(
                f"{robot.robot_type}: expected {len(robot.state)} numbers of state and {len(robot.action)} of action, "
                f"came {len(row.state)} and {len(row.action)}"
            )
        if frames and {*frames} != {*shown}:
            raise ValueError(f"a row's pictures are of {', '.join(shown)}, came {', '.join(frames)}")
        counts = bool(frames) and len(self._rows) - self._counted_row >= FPS  # one a second is enough for statistics
        for camera in robot.videos:
            self._videos[camera].add(frames.get(camera, None if self._rows else self._before))
            if counts and camera in frames:
                self._pixels[camera].add(frames[camera])
        self._counted_row = len(self._rows) if counts else self._counted_row
        self._rows.append(row)
        self._is_rendered.append(bool(frames))

    def pack(self, about: About) -> Package:
        """Returns the files of the finished episode."""
        rows = self._rows
        columns = Rows(
            state=np.stack([row.state for row in rows]),
            action=np.stack([row.action for row in rows]),
            tcp_pose=_poses(rows),
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
        videos={camera: package[f"{camera}.mp4"] for camera in pixels},
    )


def to_table(rows: Rows) -> pa.Table:
    """Returns the rows as an Arrow table."""
    columns = {each.name: getattr(rows, each.name) for each in fields(Rows)}
    return pa.table({name: _to_arrow(column) for name, column in columns.items() if column is not None})


def from_table(table: pa.Table, sizes: Mapping[str, int] | None = None) -> Rows:
    """Returns the rows of an Arrow table; unknown columns are ignored, and optional ones may be missing.

    ``sizes``: how many numbers a row of each column of vectors has; None: as many as `to_table` wrote.

    Raises:
        ValueError: a column cannot be of its type in `Rows`, or a value is null or no finite number. Other widths are
            cast: pandas, with which LeRobot's tools rewrite rows, has its own.
    """
    required = [each.name for each in fields(Rows) if each.name not in OPTIONAL]
    names = [*required, *(name for name in OPTIONAL if name in table.column_names)]
    return Rows(**{name: _from_arrow(name, table.column(name).combine_chunks(), sizes) for name in names})


def _poses(rows: list[Row]) -> NDArray[np.float32] | None:
    """Returns the tool's poses (N, 7); None if no row has one."""
    found = [row.tcp_pose for row in rows if row.tcp_pose is not None]
    if found and len(found) < len(rows):
        raise ValueError(f"{len(found)} of {len(rows)} rows have a tcp_pose; expected all or none")
    return np.stack(found) if found else None


def _executed(rows: list[Row]) -> NDArray[np.float32] | None:
    """Returns the executed actions (N, 8); None if no row has one."""
    if all(row.executed_action is None for row in rows):
        return None
    return np.stack([row.action if row.executed_action is None else row.executed_action for row in rows])


def require_finite(what: str, values: NDArray[np.floating[Any]]) -> None:
    """Raises ValueError that names the first row with a number that is NaN or infinite."""
    if not np.isfinite(values).all():
        row, *place = np.argwhere(~np.isfinite(values))[0].tolist()
        at = f"row {row}, place {place[0]}" if place else f"row {row}"
        raise ValueError(f"{what} has {values[row, *place]} in {at}; expected finite numbers")


def _to_arrow(column: Any) -> Any:
    if isinstance(column, tuple):
        return pa.array(column, pa.string())
    if column.ndim == 1:
        return pa.array(column)
    return pa.FixedSizeListArray.from_arrays(pa.array(column.reshape(-1)), column.shape[1])


def _from_arrow(name: str, column: Any, sizes: Mapping[str, int] | None) -> Any:
    if name in _VECTORS:
        kind = pa.list_(pa.float32(), column.type.list_size if sizes is None else sizes[name])
    else:
        kind = pa.bool_() if name in _TRUTHS else pa.string()
    try:
        column = column.cast(kind)
    except pa.ArrowException as error:
        raise ValueError(f"column {name} has the type {column.type}, expected {kind}: {error}") from None
    if column.null_count or (pa.types.is_nested(kind) and column.flatten().null_count):
        raise ValueError(f"column {name} has values that are null")
    if pa.types.is_string(kind):
        return tuple(column.to_pylist())
    if pa.types.is_nested(kind):
        values = column.flatten().to_numpy().reshape(len(column), kind.list_size)
        require_finite(f"column {name}", values)
        return values
    return column.to_numpy(zero_copy_only=False)
