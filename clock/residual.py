"""A hook at 20 Hz: a small head may correct every row with the newest joints, between two of POUNCE's chunks.

A chunk is made from an observation that grows old while its rows are played. A residual head looks again at every tick
(A2C2: "Leave No Observation Behind", 2025). It lives where rows are played, in the clock service: the one place that
sees every observation *and* knows the row that is due. It sees joints and no pictures, and it is a pure function of
what a tick logs, so that ``pp-check``, given the same head, derives the command again.

Any class with these two names will do; `load_head` finds its loader by a dotted name. `residual_mlp` is one.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, cast

import numpy as np

from protocol.messages import Floats, Robot

RESIDUAL_EVENT = "residual_head"
"""Tells in the log that rows were corrected, and by which head (attribute ``digest``)."""
DEFAULT_LOADER = "clock.residual_mlp:load"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Due:
    """The row that is due, and what is known at its tick."""

    row_A: Floats
    """What would be commanded, before the robot's limits: joint targets (rad), and the gripper last."""
    state: Floats
    """Newest proprioception: joint positions (rad), finger opening (m)."""
    row: int
    """Its index in the newest chunk: so many ticks old is what POUNCE saw."""
    age_ns: int
    """Of the cognition, at the chunk's invocation."""


class ResidualHead(Protocol):
    """Corrects rows. Deterministic, quick (it stands before a 50 ms deadline), and it never raises."""

    @property
    def digest(self) -> str:
        """Equal digests correct equally; logged, and compared by ``pp-check``."""
        ...

    def correction(self, due: Due) -> Floats:
        """Returns (A,) float32, to be added to the row; the gripper's is ignored."""
        ...


def corrected(head: ResidualHead | None, due: Due) -> Floats:
    """The row as it is played: ``due.row_A`` itself without a head."""
    if head is None:
        return due.row_A
    step_A = head.correction(due).astype(np.float32)
    step_A[-1] = 0.0  # the gripper is a switch, not a coordinate
    return (due.row_A + step_A).astype(np.float32)


def check_head(head: ResidualHead, robot: Robot) -> None:
    """Tries the head once on a robot, before it moves.

    Raises:
        ValueError: the head is for another robot; the message says what came.
    """
    row_A, state = robot.initial_command.astype(np.float32), np.zeros(robot.num_proprio, np.float32)
    try:
        step_A = head.correction(Due(row_A=row_A, state=state, row=0, age_ns=0))
    except Exception as error:  # whatever somebody's head raises, an episode must not begin with it
        raise ValueError(f"the residual head {head.digest} does not fit {robot.name}: {error}") from error
    if step_A.shape != row_A.shape or not np.isfinite(step_A).all():
        raise ValueError(
            f"the residual head {head.digest} does not fit {robot.name}: expected {row_A.shape} finite numbers, came "
            f"{step_A.shape}"
        )


def load_head(path: Path, loader: str = DEFAULT_LOADER) -> ResidualHead:
    """Calls ``loader``, "package.module:callable", with ``path``.

    Raises:
        ValueError: there is no such loader, or it refuses the file.
        OSError: the file cannot be read.
    """
    module_name, _, name = loader.partition(":")
    try:
        make = cast(Callable[[Path], ResidualHead], getattr(importlib.import_module(module_name), name))
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"no residual loader {loader!r} (package.module:callable): {error}") from error
    return make(path)
