"""Action spaces of POUNCE: what the network's numbers are, in terms of the robot's state and commands.

- ``joint_delta`` (as in RoboMME's released pi0.5), 8 dims: the seven joints relative to the chunk's first state, then
  the gripper. The network reads the raw state: seven joints [rad], finger opening [m].
- ``ee_delta``, 7 dims: the tool pose at the commanded joints relative to the tool pose at the chunk's first state, as
  translation [m] and rotation vector [rad], then the gripper. Both parts are in the table's frame, not the tool's, and
  separate (no screw motion): a tool that moves straight and turns about a fixed axis gives actions linear in time.
  The network's state also has 7 dims: tool position [m], rotation vector [rad] away from pointing straight down
  (for an upright tool (0, 0, yaw)), and finger opening [m].

- ``native``, as many dims as the data have: state and commands of any robot, unchanged.

Outside this module the Panda's chunks (``joint_delta``, ``ee_delta``) are absolute joint targets, and a native chunk is
what the robot is commanded. The Panda's gripper is absolute in both spaces, -1 closed to 1 open. A Panda without one
has finger 0 and command -1 and is otherwise the same arm: it keeps the gripper's tool point, which is 47 mm above the
tip of RoboMME's stick.
"""

# T targets, M chunks, N rows of a chunk, 8 = 7 arm joints (rad) + gripper (in native: as many as there are),
# D numbers of the space

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dual_system.models.arm import (
    NUM_ARM_JOINTS,
    TOOL_DOWN,
    Array,
    Poses,
    joints_near,
    rotation_vectors,
    rotations,
    tool_poses,
)

ActionSpace: TypeAlias = Literal["joint_delta", "ee_delta", "native"]

ROBOT_DIM = NUM_ARM_JOINTS + 1
"""Dims of the Panda's state and of a command, in either of its spaces."""
GRIPPER_MIN, GRIPPER_MAX = -1.0, 1.0  # closed, open
_NUM_DIMS: dict[ActionSpace, int | None] = {"joint_delta": ROBOT_DIM, "ee_delta": 7, "native": None}


def num_dims(space: ActionSpace) -> int | None:
    """Returns the number of dims of an action, and of a state as the network reads it; None if the data decide.

    Raises:
        ValueError: no such space.
    """
    if space not in _NUM_DIMS:
        raise ValueError(f"expected an action space of {', '.join(get_args(ActionSpace))}, came {space!r}")
    return _NUM_DIMS[space]


def states_in(space: ActionSpace, states_8: ArrayLike) -> Array:
    """States (..., 8) of the robot -> (..., D) as the network reads them, not yet normalised."""
    states = np.asarray(states_8, dtype=np.float64)
    if space != "ee_delta":
        return states
    tool = tool_poses(states[..., :NUM_ARM_JOINTS])
    turn = rotation_vectors(tool.rotation @ TOOL_DOWN.T)
    return np.concatenate([tool.position_m, turn, states[..., NUM_ARM_JOINTS:]], axis=-1)


def actions_in(space: ActionSpace, targets_T8: ArrayLike, states_M8: ArrayLike, rows_MN: NDArray[np.integer]) -> Array:
    """Converts a whole episode: chunk m starts at state m, and its row n commands target ``rows_MN[m, n]``.

    Returns (M, N, D), not yet normalised. Forward kinematics runs once per target and state, not once per row.
    """
    targets, states = np.asarray(targets_T8, dtype=np.float64), np.asarray(states_M8, dtype=np.float64)
    if space == "native":
        return targets[rows_MN]
    arm, gripper_MN1 = targets[:, :NUM_ARM_JOINTS], targets[rows_MN, NUM_ARM_JOINTS:]
    if space == "joint_delta":
        moves = arm[rows_MN] - states[:, None, :NUM_ARM_JOINTS]
        return np.concatenate([moves, gripper_MN1], axis=-1)
    there, here = tool_poses(arm), tool_poses(states[:, :NUM_ARM_JOINTS])
    moves = there.position_m[rows_MN] - here.position_m[:, None]
    turns = rotation_vectors(there.rotation[rows_MN] @ here.rotation[:, None].swapaxes(-1, -2))
    return np.concatenate([moves, turns, gripper_MN1], axis=-1)


def targets_from(space: ActionSpace, actions_ND: ArrayLike, state_8: ArrayLike) -> Array:
    """One chunk's actions (N, D) -> absolute joint targets and gripper (N, 8); the gripper is clipped to [-1, 1].

    Native actions are the commands (N, D); the robot's own limits apply to them later, as to all rows.

    From ``ee_delta`` the joints stay within the arm's limits. The arm is redundant (7 joints for a 6D pose): each row
    takes the joints nearest to the previous row's, the first those nearest to the state.
    """
    actions, state = np.asarray(actions_ND, dtype=np.float64), np.asarray(state_8, dtype=np.float64)
    if space == "native":
        return actions
    targets = np.empty((len(actions), ROBOT_DIM))
    targets[:, NUM_ARM_JOINTS] = actions[:, -1].clip(GRIPPER_MIN, GRIPPER_MAX)
    if space == "joint_delta":
        targets[:, :NUM_ARM_JOINTS] = actions[:, :NUM_ARM_JOINTS] + state[:NUM_ARM_JOINTS]
        return targets
    joints = state[:NUM_ARM_JOINTS]
    here = tool_poses(joints)
    wanted = Poses(here.position_m + actions[:, :3], rotations(actions[:, 3:6]) @ here.rotation)
    for row, pose in enumerate(zip(wanted.position_m, wanted.rotation, strict=True)):
        joints = joints_near(Poses(*pose), joints)
        targets[row, :NUM_ARM_JOINTS] = joints
    return targets
