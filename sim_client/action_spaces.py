"""Action spaces of other benchmarks' policies, converted to joint targets of our arm.

| space | numbers | meaning |
| --- | --- | --- |
| ``joint_angle`` | 8 | absolute joint targets [rad], gripper -1 closed to +1 open: RoboMME's and ours |
| ``ee_pose`` | 7 | absolute tool position [m] and extrinsic XYZ angles [rad] in the table's frame, gripper as above |
| ``ee_delta`` | 7 | LIBERO's: in [-1, 1], scaled to 0.05 m and 0.5 rad, from where the tool is; gripper +1 closed |

A tool pose that the arm cannot reach leaves it where it is. MuJoCo is imported only when a tool pose is to be reached.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from dual_system.tasks.kinematics import Kinematics

ActionSpace = Literal["joint_angle", "ee_pose", "ee_delta"]
Array = NDArray[np.float64]
Reader = Callable[[NDArray[Any], NDArray[Any], Any], Array]
"""From an action, the state (8,) before it and the world's model to our action (8,)."""

NUM_NUMBERS: dict[str, int] = {"joint_angle": 8, "ee_pose": 7, "ee_delta": 7}
DELTA_M, DELTA_RAD = 0.05, 0.5
"""robosuite's operational-space controller at its defaults, which LIBERO uses."""


def reader(space: ActionSpace) -> Reader:
    """How actions of ``space`` are read; one per environment.

    Raises:
        ValueError: no such space; by the reader, an action of another size or not finite.
    """
    if space not in get_args(ActionSpace):
        raise ValueError(f"action_space {space!r}: expected one of {', '.join(get_args(ActionSpace))}")
    return _ToolReader(space) if space != "joint_angle" else lambda action, state, model: _checked(action, space)


def row_of(message: Mapping[str, Any]) -> NDArray[np.float64]:
    """The one action in a model server's message, under either name that is in use. Raises ValueError if none is."""
    for name in ("actions", "action"):
        if name in message:
            return np.asarray(message[name], np.float64).ravel()
    raise ValueError(
        f"expected an action under 'actions' or 'action', came {', '.join(map(repr, message)) or 'nothing'}"
    )


def hold(space: ActionSpace, last: Mapping[str, Any] | None, joints: NDArray[Any]) -> dict[str, Any]:
    """An action that holds still: the last targets, a zero delta, or before any target the measured joints.

    Raises:
        ValueError: tool poses, before the first one.
    """
    if space == "ee_delta":
        gripper = -1.0 if last is None else float(row_of(last)[-1])
        return {"actions": np.array([0, 0, 0, 0, 0, 0, gripper], np.float32)}
    if last is not None:
        return dict(last)
    if space == "ee_pose":
        raise ValueError("ee_pose has nothing to hold before its first action: use wait_first_action, or joint_angle")
    return {"actions": np.append(joints, 1.0).astype(np.float32)}


class _ToolReader:
    """Tool poses, solved for the joints nearest to where they are."""

    def __init__(self, space: ActionSpace) -> None:
        self._space = space
        self._solver: tuple[Any, Kinematics] | None = None

    def __call__(self, action: NDArray[Any], state: NDArray[Any], model: Any) -> Array:
        from dual_system.tasks.kinematics import Kinematics, UnreachableError

        wanted = _checked(action, self._space)
        if self._solver is None or self._solver[0] is not model:
            self._solver = (model, Kinematics(model))
        kinematics, joints = self._solver[1], np.asarray(state[:7], np.float64)
        target = _absolute(wanted) if self._space == "ee_pose" else _moved(kinematics.tcp(joints), wanted)
        gripper = wanted[6] if self._space == "ee_pose" else -np.sign(wanted[6])
        with contextlib.suppress(UnreachableError):
            joints = kinematics.solve(target, joints)
        return np.append(joints, np.clip(gripper, -1.0, 1.0))


def _checked(action: NDArray[Any], space: str) -> Array:
    expected = NUM_NUMBERS[space]
    numbers = np.asarray(action, np.float64).ravel()
    if len(numbers) != expected or not np.isfinite(numbers).all():
        others = ", ".join(f"{name} ({count})" for name, count in NUM_NUMBERS.items() if name != space)
        raise ValueError(
            f"an action of {space} has {expected} finite numbers, came {numbers.tolist()}. "
            f"Other values of action_space: {others}."
        )
    return numbers


def _absolute(wanted: Array) -> Array:
    """The transform (4, 4) of xyz and extrinsic XYZ angles."""
    T = np.eye(4)
    T[:3, :3] = _turn((0, 0, wanted[5])) @ _turn((0, wanted[4], 0)) @ _turn((wanted[3], 0, 0))
    T[:3, 3] = wanted[:3]
    return T


def _moved(here: Array, wanted: Array) -> Array:
    """The transform after a step of the operational-space controller; both parts are along the world's axes."""
    delta = np.clip(wanted[:6], -1.0, 1.0)
    T = here.copy()
    T[:3, 3] += DELTA_M * delta[:3]
    T[:3, :3] = _turn(DELTA_RAD * delta[3:6]) @ T[:3, :3]
    return T


def _turn(rotation: Any) -> Array:
    """The rotation matrix (3, 3) of a rotation vector (3,) [rad]."""
    from dual_system.tasks.geometry import screw_exp

    turned: Array = screw_exp(np.append(np.zeros(3), rotation))[:3, :3]
    return turned
