"""What the dimensions of a robot's commands are, as arrays; how increments become targets, and how velocities end.

A robot that does not describe its dimensions has joints in the order of its state, and last a gripper.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from protocol.messages import AtStop, Dimension, DimensionKind, Floats, Robot

# A dims of a command, N rows


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dimensions:
    """Facts about each dimension of a command.

    Attributes:
        measured: indices of the dims that are measured; ``state_index`` are their values' indices in the state.
        targets: indices of the measured dims that are absolute targets of joints; ``state_of_targets`` likewise.
        ends_measured_A: dims that a stop leads to where they were measured.
    """

    measured: NDArray[np.intp]
    state_index: NDArray[np.intp]
    targets: NDArray[np.intp]
    state_of_targets: NDArray[np.intp]
    deltas: NDArray[np.intp]
    state_of_deltas: NDArray[np.intp]
    velocities: NDArray[np.intp]
    is_gripper_A: NDArray[np.bool_]
    ends_measured_A: NDArray[np.bool_]


@lru_cache(maxsize=64)  # a robot's description lives as long as its episode
def dimensions_of(robot: Robot) -> Dimensions:
    each = robot.dimensions or _unsaid(robot)
    kinds = np.array([dim.kind for dim in each])
    state_A = np.array([-1 if dim.state_index is None else dim.state_index for dim in each])
    is_target = (state_A >= 0) & np.isin(kinds, (DimensionKind.POSITION, DimensionKind.DELTA))
    measured, targets = np.flatnonzero(state_A >= 0), np.flatnonzero(is_target)
    deltas = np.flatnonzero(kinds == DimensionKind.DELTA)
    return Dimensions(
        measured=measured,
        state_index=state_A[measured],
        targets=targets,
        state_of_targets=state_A[targets],
        deltas=deltas,
        state_of_deltas=state_A[deltas],
        velocities=np.flatnonzero(kinds == DimensionKind.VELOCITY),
        is_gripper_A=kinds == DimensionKind.GRIPPER,
        ends_measured_A=np.array([dim.at_stop == AtStop.MEASURED for dim in each]),
    )


def _unsaid(robot: Robot) -> tuple[Dimension, ...]:
    last = robot.action_dim - 1
    measured = [index if index < robot.num_proprio else None for index in range(robot.action_dim)]
    joint, gripper = DimensionKind.POSITION, DimensionKind.GRIPPER
    joints = [
        Dimension(name=f"joint_{index}", kind=joint, state_index=at, at_stop=AtStop.MEASURED)
        for index, at in enumerate(measured[:last])
    ]
    return (*joints, Dimension(name="gripper", kind=gripper, state_index=measured[last], at_stop=AtStop.KEEP))


def absolute(rows_NA: Floats, state: Floats, robot: Robot) -> Floats:
    """A chunk's rows with increments summed up from ``state``, (num_proprio,), that of the chunk's observation.

    From a state of another length they are NaN, which is never commanded.
    """
    dims = dimensions_of(robot)
    if not len(dims.deltas):
        return rows_NA
    rows = rows_NA.copy()
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is not commanded
        sums = np.cumsum(rows_NA[:, dims.deltas], axis=0, dtype=np.float32)
        is_state = len(state) == robot.num_proprio
        rows[:, dims.deltas] = (state[dims.state_of_deltas] if is_state else np.float32(np.nan)) + sums
    return rows


def coasting(command: Floats, played: Floats, robot: Robot, idle_ticks: int) -> Floats:
    """``command``, (action_dim,), with the velocities of a robot that has had no row for ``idle_ticks``.

    They are on a line from those ``played`` last to zero, which is reached after the robot's ``stop_ticks``. The clock
    and the robot's side apply it, each for as long as it has nothing to play.
    """
    velocities = dimensions_of(robot).velocities
    if not len(velocities):
        return command
    slowed = command.copy()
    left = max(0, robot.stop_ticks - idle_ticks)
    slowed[velocities] = played[velocities] * np.float32(left / robot.stop_ticks)
    return slowed
