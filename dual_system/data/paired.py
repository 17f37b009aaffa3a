"""Paired episodes of the kitchen: a GR-1's demonstration, then the PandaOmron's execution from the same start.

A dataset of ours (`lerobot_v3`) with 53 numbers of state, 12 of action, three views, and the demonstration in a camera
of its own. Beside LeRobot's tables lies ``meta/splits.json``: which tasks and episodes each split holds out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dual_system.data.episode import DEMO_CAMERA, About, EpisodeWriter, Package, RobotColumns, Row
from dual_system.data.lerobot_files import write_json
from dual_system.data.video import Frame
from dual_system.tasks.kitchen.catalogue import UNSEEN_BY_CATEGORY, UNSEEN_BY_PRECISION
from dual_system.tasks.kitchen.layout import ACTION_NAMES, STATE_NAMES
from dual_system.tasks.kitchen.omron import VIEWS

PANDA_OMRON = RobotColumns(
    robot_type="panda_omron", state=STATE_NAMES, action=ACTION_NAMES, cameras=VIEWS, has_demo_camera=True
)
SPLITS_PATH = "meta/splits.json"
HELD_OUT = {"category_balanced": UNSEEN_BY_CATEGORY, "precision_sensitive": UNSEEN_BY_PRECISION}
"""Tasks that each split holds out. A task may be held out by both, so each needs a model of its own."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Instant:
    """One row of an execution: what was measured and seen before the action, and the action."""

    state: NDArray[np.float32]  # (53,)
    action: NDArray[np.float32]  # (12,)
    frames: Mapping[str, Frame]  # of `VIEWS`; empty: the last ones are repeated


def pack_pair(demo: Sequence[Frame | None], execution: Iterable[Instant], about: About, *, words: str = "") -> Package:
    """Returns the files of a pair.

    Args:
        demo: the demonstration at 20 Hz, None where the last frame is repeated. Its rows have the robot's own state and
            action of the first instant: it stands there meanwhile.
        execution: rows at 20 Hz.
        words: the goal, as the subgoal of the whole execution. A row that is told it in words reads it; PONDER does not
            unless its recipe is grounded.

    Raises:
        ValueError: there is no instant, or one of another robot, or the demonstration does not begin with a frame.
    """
    writer, is_first = EpisodeWriter(about.image_px, PANDA_OMRON), True
    if demo and demo[0] is None:
        raise ValueError(f"{about.task} {about.seed}: the demonstration's first row has no frame")
    for instant in execution:
        if is_first:
            for frame in demo:
                row = _row(instant, "", is_demonstration=True)
                writer.add(row, {} if frame is None else {DEMO_CAMERA: frame})
        writer.add(_row(instant, words, is_transition=is_first and bool(words)), instant.frames)
        is_first = False
    if is_first:
        raise ValueError(f"{about.task} {about.seed}: an execution without an instant")
    return writer.pack(about)


def _row(instant: Instant, words: str, *, is_transition: bool = False, is_demonstration: bool = False) -> Row:
    return Row(
        state=instant.state,
        action=instant.action,
        subgoal=words,
        grounded_subgoal=words,
        is_transition=is_transition,
        is_demonstration=is_demonstration,
    )


def write_splits(root: Path, tasks: Sequence[str]) -> None:
    """Writes ``meta/splits.json``. ``tasks``: the task of every episode, in order.

    ``LeRobotDataset(..., episodes=splits["category_balanced"]["seen"]["episodes"])`` reads a split in LeRobot, and
    ``pp-train --tasks`` takes the names.
    """
    splits = {
        name: {
            "seen": _part(tasks, [task for task in dict.fromkeys(tasks) if task not in held_out]),
            "unseen": _part(tasks, [task for task in dict.fromkeys(tasks) if task in held_out]),
        }
        for name, held_out in HELD_OUT.items()
    }
    write_json(root / SPLITS_PATH, splits)


def _part(tasks: Sequence[str], names: Sequence[str]) -> dict[str, list[str] | list[int]]:
    return {"tasks": list(names), "episodes": [index for index, task in enumerate(tasks) if task in names]}
