"""A mapping file: which columns of somebody else's LeRobot v3 folder are what in a dataset here.

TOML; docs/data.md explains it field by field. Without a file the mapping is that of ``lerobot/robomme``.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dual_system.data.episode import require_finite
from dual_system.data.errors import DatasetError
from dual_system.data.lerobot_files import MAX_HZ, MIN_HZ
from dual_system.models.config_json import from_json
from protocol import files

ROBOT_DIM = 8
FINGER_M = (0.0, 0.04)
"""Opening of a closed and of an open finger."""
GRIPPER = (-1.0, 1.0)
"""Command that closes and that opens."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cameras:
    """Names of the features that are a robot's cameras."""

    front: str
    wrist: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """Eight numbers of a column: seven joints [rad] and the gripper."""

    column: str
    dims: tuple[int, ...] = (0, 1, 2, 3, 4, 5, 6, 7)
    """Places of the seven joints and of the gripper; seven places: the robot has no gripper (the stick)."""
    closed: float
    """The gripper's number when it is closed."""
    opened: float
    """The gripper's number when it is open."""

    def __post_init__(self) -> None:
        if not len(self.dims) == len({*self.dims}) in (ROBOT_DIM - 1, ROBOT_DIM) or min(self.dims) < 0:
            raise ValueError(
                f"{self.column}: dims must be the places of seven joints and the gripper, each once, came {self.dims}"
            )
        if self.closed == self.opened:
            raise ValueError(f"{self.column}: closed and opened are both {self.closed}")

    def read(self, values_TD: NDArray[np.floating[Any]], ours: tuple[float, float]) -> NDArray[np.float32]:
        """(T, 8) of the column's (T, D), with the gripper scaled to ``ours`` (closed, open).

        Raises ValueError if the column is narrower, or has numbers that are not finite or not when they are scaled.
        """
        if values_TD.ndim != 2 or values_TD.shape[1] <= max(self.dims):
            raise ValueError(f"column {self.column} has the shape {values_TD.shape[1:]}, and place {max(self.dims)}"
                             " of it is to be read")  # fmt: skip
        closed, opened = self.closed, self.opened
        with np.errstate(all="ignore"):  # what overflows is refused below
            found = values_TD[:, list(self.dims)].astype(np.float32)
            if len(self.dims) < ROBOT_DIM:
                found = np.pad(found, ((0, 0), (0, 1)), constant_values=ours[0])
            elif (closed, opened) != ours:
                found[:, -1] = ours[0] + (found[:, -1] - closed) / (opened - closed) * (ours[1] - ours[0])
        require_finite(f"column {self.column} (gripper from closed = {closed:g}, opened = {opened:g})", found)
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceMapping:
    """How a LeRobot v3 folder becomes a dataset here. Texts may be ""; then the folder has no such column."""

    cameras: Cameras
    state: Arm
    action: Arm
    action_kind: Literal["target", "delta"] = "target"
    """target: absolute joint targets; delta: added to the state of the same row. The gripper is absolute in both."""
    order: Literal["state first", "action first"] = "state first"
    """state first: a row's action follows what the row shows. action first: a row shows what its action led to."""
    rows_hz: float | None = None
    """Rows a second, if ``fps`` of the folder is a label and not the rate at which rows were recorded."""
    subgoal: str = ""
    grounded_subgoal: str = ""
    demonstration: str = ""
    """Column of truths: the row belongs to a conditioning video, which comes first."""
    done_text: str = ""
    """Subgoal that means none; the one before it stays in force."""
    task: str = ""
    """Name of the task in all episodes; "": the name of the folder."""

    def __post_init__(self) -> None:
        if self.rows_hz is not None and not MIN_HZ <= self.rows_hz <= MAX_HZ:
            raise ValueError(f"rows_hz: expected a rate of {MIN_HZ} to {MAX_HZ} Hz, came {self.rows_hz}")

    def columns(self) -> tuple[str, ...]:
        """Columns to read, each once."""
        texts = (self.subgoal, self.grounded_subgoal, self.demonstration)
        return tuple(dict.fromkeys(name for name in (self.state.column, self.action.column, *texts) if name))


ROBOMME = SourceMapping(
    cameras=Cameras(front="image", wrist="wrist_image"),
    state=Arm(column="state", closed=FINGER_M[0], opened=FINGER_M[1]),
    action=Arm(column="actions", closed=GRIPPER[0], opened=GRIPPER[1]),
    order="action first",
    rows_hz=20,
    subgoal="simple_subgoal",
    grounded_subgoal="grounded_subgoal",
    demonstration="is_demo",
    done_text="complete",
)
"""``lerobot/robomme``, by its card and RoboMME's recorder: labelled 10 fps, and a row is one control step of 50 ms. The
card that was read shows the columns up to the cameras; the others are named after the benchmark's own data."""


def read_mapping(path: Path | None) -> SourceMapping:
    """The mapping of a file; None: `ROBOMME`.

    Raises:
        DatasetError: the file is no TOML, lacks a field, or has one that is unknown or does not fit.
        OSError: it cannot be read.
    """
    if path is None:
        return ROBOMME
    text = files.read_text(path, "mapping file")
    try:
        return from_json(SourceMapping, tomllib.loads(text), str(path))
    except (ValueError, TypeError) as error:  # tomllib's errors are ValueErrors
        raise DatasetError(f"{path}: {error}" if str(path) not in str(error) else str(error)) from None
