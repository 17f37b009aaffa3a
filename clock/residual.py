"""Residual heads: a small head may correct every row at 20 Hz with the newest joints, between two of POUNCE's chunks.

A chunk's observation ages while its rows are played. A residual head reads the newest one at every tick (A2C2: "Leave
No Observation Behind", 2025). It runs in the clock service, the only place that has every observation *and* the row
that is due. It reads joints and no pictures, and it is a pure function of a tick's logged values, so that ``pp-check``,
given the same head, derives the command again.

Any class with these two names will do; `load_head` finds its loader by a dotted name. `residual_mlp` is an example.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from protocol.messages import Floats, Robot

RESIDUAL_EVENT = "residual_head"
"""Event that logs the head that corrects the rows (attribute ``digest``)."""
DEFAULT_LOADER = "clock.residual_mlp:load"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Due:
    """The row that is due, with the inputs of a correction at its tick."""

    row_A: Floats
    """Command before correction and the robot's limits: joint targets (rad), then the gripper."""
    state: Floats
    """Newest proprioception: joint positions (rad), finger opening (m)."""
    row: int
    """Index in the newest chunk, which is the age of POUNCE's observation in ticks."""
    age_ns: int
    """Age of the cognition at the chunk's invocation."""


class ResidualHead(Protocol):
    """Corrects rows. It must be deterministic, fast (it runs before a 50 ms deadline) and never raise."""

    @property
    def digest(self) -> str:
        """Digest of the head; equal digests mean equal corrections. Logged, and compared by ``pp-check``."""
        ...

    def correction(self, due: Due) -> Floats:
        """Returns (A,) float32, to be added to the row; a gripper's is ignored."""
        ...


def corrected(head: ResidualHead | None, due: Due, is_gripper_A: NDArray[np.bool_]) -> Floats:
    """The row as it is played: ``due.row_A`` itself without a head."""
    if head is None:
        return due.row_A
    step_A = head.correction(due).astype(np.float32)
    step_A[is_gripper_A] = 0.0  # a gripper is binary: do not correct it
    return (due.row_A + step_A).astype(np.float32)


def check_head(head: ResidualHead, robot: Robot) -> None:
    """Runs the head once for a robot, before it moves.

    Raises:
        ValueError: the head is for another robot.
    """
    row_A, state = robot.initial_command.astype(np.float32), np.zeros(robot.num_proprio, np.float32)
    try:
        step_A = head.correction(Due(row_A=row_A, state=state, row=0, age_ns=0))
    except Exception as error:  # a head that raises anything must not start an episode
        raise ValueError(f"the residual head {head.digest} does not fit {robot.name}: {error}") from error
    if step_A.shape != row_A.shape or not np.isfinite(step_A).all():
        raise ValueError(
            f"the residual head {head.digest} does not fit {robot.name}: expected {row_A.shape} finite numbers, came "
            f"{step_A.shape}"
        )


def load_head(path: Path, loader: str = DEFAULT_LOADER) -> ResidualHead:
    """Calls ``loader``, "package.module:callable", with ``path``.

    Raises:
        ValueError: there is no such loader, or it rejects the file.
        OSError: the file cannot be read.
    """
    module_name, _, name = loader.partition(":")
    try:
        make = cast(Callable[[Path], ResidualHead], getattr(importlib.import_module(module_name), name))
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"no residual loader {loader!r} (package.module:callable): {error}") from error
    return make(path)
