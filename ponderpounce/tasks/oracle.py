"""The oracle's motion library: generators of absolute joint targets, written as one would tell a robot what to do.

Every motion plans from where the arm is when it starts, not from where it was told to be, so it must be consumed
step by step with the physics: next action, advance, next action. Motions are straight screws of the tool, timed to
the arm's speed and acceleration limits; a gripper command holds the arm still for six steps.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ponderpounce.tasks import timing
from ponderpounce.tasks.geometry import Array, transform
from ponderpounce.tasks.kinematics import Kinematics, UnreachableError
from ponderpounce.tasks.physics import CONTROL_HZ, Physics
from ponderpounce.tasks.scene import BUTTON_BASE_HEIGHT_M

Actions = Iterator[NDArray[np.float32]]

MAX_SPEED_RAD_S = 0.9
MAX_ACCELERATION_RAD_S2 = 0.9
GRIPPER_STEPS = 6
OPEN, CLOSED = 1.0, -1.0

_PATH_POINTS = 40
_ABOVE_M = 0.15
_DOWN = np.array([0.0, 0.0, -1.0])


class Motions:
    """What the oracle can do with one arm. Actions are (8,) float32: seven joint targets [rad], gripper in [-1, 1]."""

    def __init__(self, physics: Physics) -> None:
        self._physics = physics
        self._kinematics = Kinematics(physics.model)
        self._gripper = physics.gripper_command()  # it may be holding something already

    def move(self, target: Array) -> Actions:
        """Moves the tool along a straight screw to a transform (4, 4). Raises UnreachableError, before moving."""
        path = self._kinematics.screw_path(self._physics.arm_qpos(), target, _PATH_POINTS)
        quickest = timing.fastest(path, max_speed=MAX_SPEED_RAD_S, max_acceleration=MAX_ACCELERATION_RAD_S2)
        for qpos in timing.sample(path, quickest, 1 / CONTROL_HZ):
            yield self._action(qpos)

    def hold(self, num_steps: int) -> Actions:
        """Keeps the arm where it is and the gripper as it was told."""
        qpos = self._physics.arm_qpos()
        for _ in range(num_steps):
            yield self._action(qpos)

    def open(self) -> Actions:
        """Opens the gripper."""
        self._gripper = OPEN
        yield from self.hold(GRIPPER_STEPS)

    def close(self) -> Actions:
        """Closes the gripper, or squeezes what is between the fingers."""
        self._gripper = CLOSED
        yield from self.hold(GRIPPER_STEPS)

    def press(self, button: str) -> Actions:
        """Presses a button with the closed gripper and comes back up."""
        x_m, y_m, _ = self._physics.position_m(button)
        upright = _tool(np.array([0.0, -1.0, 0.0]))
        yield from self.open_at(_at(upright, x_m, y_m, _ABOVE_M))
        yield from self.close()
        yield from self.move(_at(upright, x_m, y_m, BUTTON_BASE_HEIGHT_M / 2))
        yield from self.move(_at(upright, x_m, y_m, _ABOVE_M))

    def pick(self, cube: str) -> Actions:
        """Grasps a cube from above and lifts it, turning as little as the arm's limits allow."""
        yield from self.open()
        x_m, y_m, z_m = self._physics.position_m(cube)
        grasp, approach = self._reachable_grasp(cube, x_m, y_m)
        yield from approach
        yield from self.open()
        yield from self.move(_at(grasp, x_m, y_m, z_m))
        yield from self.close()
        yield from self.move(_at(grasp, x_m, y_m, _ABOVE_M))

    def put_down(self, release_z_m: float) -> Actions:
        """Lowers the tool straight down to a height, lets go, and comes back up."""
        here = self._physics.tcp_transform()
        x_m, y_m, _ = here[:3, 3]
        yield from self.move(_at(here, x_m, y_m, release_z_m))
        yield from self.open()
        yield from self.move(_at(here, x_m, y_m, _ABOVE_M))

    def open_at(self, target: Array) -> Actions:
        """Moves the tool to a transform (4, 4), then opens the gripper there."""
        yield from self.move(target)
        yield from self.open()

    def _reachable_grasp(self, cube: str, x_m: float, y_m: float) -> tuple[Array, Actions]:
        """The first grasp of a cube that can be approached, and the way there.

        A cube can be closed upon along four directions; the nearest to the present one is tried first.
        """
        closing = self._physics.tcp_transform()[:3, 1]
        sides = transform(self._physics.pose(cube))[:3, :2].T
        directions = sorted([*sides, *-sides], key=lambda side: -float(side @ closing))
        failures = []
        for direction in directions:
            grasp = _tool(direction)
            above = _at(grasp, x_m, y_m, _ABOVE_M)
            try:
                self._kinematics.screw_path(self._physics.arm_qpos(), above, _PATH_POINTS)
            except UnreachableError as error:
                failures.append(str(error))
                continue
            return grasp, self.move(above)
        raise UnreachableError(f"no grasp of {cube!r} can be approached: " + "; ".join(failures))

    def _action(self, qpos: Array) -> NDArray[np.float32]:
        return np.append(qpos, self._gripper).astype(np.float32)


def _tool(closing: Array) -> Array:
    """A transform (4, 4) at the origin with the palm facing down and the fingers closing along a direction (3,)."""
    y = closing * [1.0, 1.0, 0.0]
    y = y / np.linalg.norm(y)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([np.cross(y, _DOWN), y, _DOWN])
    return T


def _at(T: Array, x_m: float, y_m: float, z_m: float) -> Array:
    moved = T.copy()
    moved[:3, 3] = x_m, y_m, z_m
    return moved
