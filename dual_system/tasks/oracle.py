"""The oracle's motion library: generators of absolute joint targets, written like instructions to a robot.

Every motion plans from the arm's measured pose when it starts, not from its last target, so it must be consumed
step by step with the physics: next action, advance, next action. Motions are straight screws of the tool, timed to
the arm's speed and acceleration limits; a gripper command holds the arm still for six steps.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dual_system.tasks import panda, timing
from dual_system.tasks.containers import GRIP_Z_M
from dual_system.tasks.geometry import Array, transform
from dual_system.tasks.kinematics import Kinematics, UnreachableError
from dual_system.tasks.physics import CONTROL_HZ, Physics
from dual_system.tasks.scene import BUTTON_BASE_HEIGHT_M
from dual_system.tasks.tool_poses import (
    DOWN,
    LEFT,
    OVER_M,
    OVER_Z_M,
    at_height,
    facing_down,
    is_over,
    lying_along,
    put_at,
    ways_of_carrying,
)

Action = NDArray[np.float32]
Actions = Iterator[Action]

MAX_ACCELERATION_RAD_S2 = 0.9
GRIPPER_STEPS = 6
HOMING_STEPS = 30
OPEN, CLOSED = 1.0, -1.0
REST_XYZ_M = (0.0, 0.0, 0.2)

_PATH_POINTS = 40
_ABOVE_M = 0.15
_HIGH_M, _BACK_OFF_M = 0.20, 0.1
_SWING_M = 0.10
_TIP_M = 0.07  # of the stick, over what it points at
_ARC_POINTS, _ARC_PAUSE = 45, 5  # control steps
_MISS_M, _MISS_CONTAINER_M = 0.04, 0.035
_UPRIGHT = 0.7  # of a cube's axis: one that points up this much is none to close along
_EMPTY_M = 0.01  # of a finger: closed that far, there is nothing between them
_BAR_LIFTS_M = (0.20, 0.16, 0.13)  # a bar counts as lifted above 0.10
_PUSH_FROM_M, _PUSH_SHORT_M, _PUSH_BACK_M = 0.05, 0.02, 0.02  # of the tool: behind the body, before the target
_HOOK_FROM_M, _HOOK_SHORT_M, _HOOK_ASIDE_M, _HOOK_ABOVE_M = 0.1, 0.03, 0.1, 0.1
_QUARTERS = ((1, 0), (0, 1), (0, -1), (-1, 0))  # cosine and sine of 0, 90, -90 and 180 degrees


@dataclass(frozen=True, slots=True, kw_only=True)
class FailedGrasp:
    """A grasp that closes beside or above the object before the right one: demonstrations of recovery."""

    before: int  # which of the script's grasps it precedes, from 0
    offset: tuple[int, int, int]  # where it is aimed: -1, 0 or 1 times upstream's miss along x, y and z


class Motions:
    """The oracle's motions of one arm. Actions are (8,) float32: seven joint targets [rad], gripper in [-1, 1].

    ``num_grasps`` counts the grasps begun so far, without the failed ones.

    With ``watches`` a grasp follows an object that moves meanwhile; without, as upstream, it closes where that was.

    With ``resumes`` the first grasp takes over from another controller: it continues from the tool's pose, down on
    the object, up with it, or up and over it once more. ``has_resumed`` is true from then on.
    """

    def __init__(
        self,
        physics: Physics,
        failed_grasp: FailedGrasp | None = None,
        *,
        resumes: bool = False,
        watches: bool = False,
    ) -> None:
        self.num_grasps = 0
        self.has_resumed = False
        self._failed_grasp = failed_grasp
        self._resumes = resumes
        self._watches = watches
        self._physics = physics
        self._kinematics = Kinematics(physics.model)
        self._max_speed_rad_s = physics.robot.oracle_speed_rad_s
        self._gripper = physics.gripper_command()  # it may be holding something already

    @property
    def strays_by(self) -> int:
        """Side to which an insertion first strays, 1 or -1, if a grasp is made to fail; else 0."""
        return 0 if self._failed_grasp is None else next((sign for sign in self._failed_grasp.offset if sign), 1)

    def move(self, target: Array) -> Actions:
        """Moves the tool along a straight screw to a transform (4, 4). Raises UnreachableError, before moving."""
        path = self._kinematics.screw_path(self._physics.arm_qpos(), target, _PATH_POINTS, stopping_at_limits=True)
        quickest = timing.fastest(path, max_speed=self._max_speed_rad_s, max_acceleration=MAX_ACCELERATION_RAD_S2)
        for qpos in timing.sample(path, quickest, 1 / CONTROL_HZ):
            yield self._action(qpos)

    def hold(self, num_steps: int) -> Actions:
        """Holds the arm's pose and the gripper's last command."""
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
        """Goes to a button, presses it with the closed gripper and comes back up."""
        yield from self.open_at(self._above_button(button))
        yield from self.push_down(button)

    def hover(self, button: str) -> Actions:
        """Waits above a button with the gripper closed."""
        yield from self.move(self._above_button(button))
        yield from self.close()

    def push_down(self, button: str) -> Actions:
        """Presses the button below with the closed gripper and comes back up."""
        yield from self.close()
        above = self._above_button(button)
        yield from self.move(at_height(above, BUTTON_BASE_HEIGHT_M / 2))
        yield from self.move(above)

    def wait_until(self, elapsed_steps: int) -> Actions:
        """Stands still until ``elapsed_steps`` control steps after reset, in rounds of a gripper command's length."""
        while self._physics.elapsed_steps() < elapsed_steps:
            yield from self.hold(GRIPPER_STEPS)

    def wait(self, num_steps: int) -> Actions:
        """Stands still for at least ``num_steps`` control steps, in rounds of a gripper command's length."""
        for _ in range(0, num_steps, GRIPPER_STEPS):
            yield from self.hold(GRIPPER_STEPS)

    def rest(self) -> Actions:
        """Goes to a place low above the middle of the table, and opens the gripper there."""
        yield from self.open_at(self._carried_to(*REST_XYZ_M))

    def go_home(self, num_steps: int = HOMING_STEPS) -> Actions:
        """Opens the gripper if there is one, then commands the home posture and gives the arm time to get there."""
        if self._physics.robot.has_gripper:
            yield from self.open()
        yield from self._stay_at(panda.HOME_QPOS, num_steps)

    def pick(self, cube: str) -> Actions:
        """Grasps a cube from above and lifts it, turning as little as the arm's limits allow."""
        yield from self._grasp(cube, from_z_m=_ABOVE_M, grasp_z_m=self._physics.position_m(cube)[2], miss_m=_MISS_M)

    def pick_container(self, container: str) -> Actions:
        """Grasps a standing container by the block on its lid and lifts it high enough to show what it hid."""
        yield from self._grasp(container, from_z_m=_HIGH_M, grasp_z_m=GRIP_Z_M, miss_m=_MISS_CONTAINER_M)

    def put_down(self, release_z_m: float) -> Actions:
        """Lowers the tool straight down to a height, lets go, and comes back up."""
        here = self._physics.tcp_transform()
        x_m, y_m, _ = here[:3, 3]
        yield from self.move(put_at(here, x_m, y_m, release_z_m))
        yield from self.open()
        yield from self.move(put_at(here, x_m, y_m, _ABOVE_M))

    def let_go(self) -> Actions:
        """Opens the gripper where it is and comes straight up."""
        yield from self.open()
        yield from self.move(at_height(self._physics.tcp_transform(), _ABOVE_M))

    def place(self, target: str) -> Actions:
        """Carries what is held over a target, sets it down there and comes back up."""
        yield from self.place_at(*self._physics.position_m(target))

    def place_at(self, x_m: float, y_m: float, release_z_m: float) -> Actions:
        """Carries what is held over a point, lowers the tool to a height, lets go and comes back up."""
        above = self._carried_to(x_m, y_m, _ABOVE_M)
        yield from self.move(above)
        yield from self.move(at_height(above, release_z_m))
        yield from self.open()
        yield from self.move(above)

    def drop_into(self, container: str) -> Actions:
        """Carries what is held over a container, lets it fall, and backs off towards the robot."""
        x_m, y_m, _ = self._physics.position_m(container)
        yield from self.open_at(self._carried_to(x_m, y_m, _HIGH_M))
        yield from self.move(self._carried_to(x_m - _BACK_OFF_M, y_m, _HIGH_M))

    def swing_over(self, target: str) -> Actions:
        """Carries what is held to a place low above a target."""
        x_m, y_m, _ = self._physics.position_m(target)
        yield from self.move(self._carried_to(x_m, y_m, _SWING_M))

    def point_at(self, target: str) -> Actions:
        """Brings the stick's tip low over a target, makes up for what the arm lagged, and rests there a moment."""
        for _ in range(2):
            yield from self.move(self._tip_over(target))
        yield from self.hold(GRIPPER_STEPS)

    def point_at_once(self, target: str, num_steps: int = HOMING_STEPS) -> Actions:
        """Commands the posture in which the stick points at a target, and gives the arm time to get there."""
        path = self._kinematics.screw_path(self._physics.arm_qpos(), self._tip_over(target), _PATH_POINTS)
        yield from self._stay_at(path[-1], num_steps)

    def sweep_to(self, target: str, bulge_m: float) -> Actions:
        """Sweeps the stick's tip to a target and rests there a moment, one point of the way per control step.

        The way is a parabola (a quadratic Bezier curve) in the plane; ``bulge_m`` is how far its control point lies to
        the left of the chord's middle, seen in the direction of motion. Raises UnreachableError, before moving.
        """
        here, there = self._physics.tcp_transform(), self._tip_over(target)
        start_m, end_m = here[:2, 3], there[:2, 3]
        way_m = end_m - start_m
        control_m = (start_m + end_m) / 2 + bulge_m * np.array([-way_m[1], way_m[0]]) / np.linalg.norm(way_m)
        qpos, path = self._physics.arm_qpos(), []
        for s in np.linspace(0.0, 1.0, _ARC_POINTS):
            x_m, y_m = (1 - s) ** 2 * start_m + 2 * s * (1 - s) * control_m + s**2 * end_m
            qpos = self._kinematics.solve(put_at(here, x_m, y_m, _TIP_M), qpos)
            path.append(qpos)
        for qpos in path:
            yield self._action(qpos)
        yield from self._stay_at(path[-1], _ARC_PAUSE)

    def pick_bar(self, end: str, onward: Sequence[Array] = ()) -> Actions:
        """Grasps a lying bar from above across one of its ends, and lifts it as high as the arm can there.

        ``onward`` are poses (4, 4) that the end will be carried to. The bar is grasped the way round that leads there.
        """
        yield from self.open()
        failed = self._begin_grasp()
        above, grasp = self._over_bar(end, onward)
        if failed is not None:
            yield from self._miss_bar(end, above, grasp, is_high=failed.offset[2] > 0)
            above, grasp = self._over_bar(end, onward)
        yield from self.move(above)
        yield from self.move(grasp)
        yield from self.close()
        yield from self.move(above)
        yield from self.close()

    def carry(self, body: str, poses: Sequence[Array]) -> Actions:
        """Carries a held body to poses (4, 4), one after another, however it lies in the hand."""
        way = self._first_way(
            ways_of_carrying(transform(self._physics.pose(body)), self._physics.tcp_transform(), poses)
        )
        for detour in way[: -len(poses)]:
            yield from self.move(detour)
        for pose in poses:
            in_hand = np.linalg.inv(transform(self._physics.pose(body))) @ self._physics.tcp_transform()
            yield from self.move(pose @ in_hand)

    def push(self, body: str, target: str) -> Actions:
        """Pushes a body over the table onto a target with the closed gripper, and opens it there."""
        start_m, ahead, left = self._straight_to(body, target)
        start_m -= _PUSH_FROM_M * ahead
        end_m = self._physics.position_m(target) - _PUSH_SHORT_M * ahead
        end_m[2] = start_m[2]
        # rather facing away from the robot
        tools = sorted((facing_down(left), facing_down(-left)), key=lambda T: -float(T[0, 0]))
        above, behind, _ = self._first_way(
            [[at_height(put_at(T, *start_m), _ABOVE_M), put_at(T, *start_m), put_at(T, *end_m)] for T in tools]
        )
        yield from self.open()
        yield from self.move(above)
        yield from self.move(behind)
        yield from self.close()
        yield from self.move(put_at(behind, *end_m))
        yield from self.move(put_at(behind, *(end_m - _PUSH_BACK_M * ahead)))  # opening fingers would kick the body
        yield from self.open()

    def hook(self, end: str, body: str, target: str) -> Actions:
        """Draws a body over the table onto a target with a bar held at one end, and lets go of the bar there."""
        yield from self.carry(end, self.hooking(body, target))
        yield from self.open()

    def hooking(self, body: str, target: str) -> list[Array]:
        """Where (4, 4) the tail of a bar is carried to draw a body onto a target: above, down behind it, and along.

        The bar lies across the way; the hand stays on the robot's side of it.
        """
        start_m, ahead, left = self._straight_to(body, target)
        across = left if left[0] > 0 else -left
        behind = put_at(lying_along(across), *(start_m - _HOOK_FROM_M * ahead - _HOOK_ASIDE_M * across))
        end_m = self._physics.position_m(target) - _HOOK_SHORT_M * ahead - _HOOK_ASIDE_M * across
        return [at_height(behind, _HOOK_ABOVE_M), behind, put_at(behind, end_m[0], end_m[1], start_m[2])]

    def open_at(self, target: Array) -> Actions:
        """Moves the tool to a transform (4, 4), then opens the gripper there."""
        yield from self.move(target)
        yield from self.open()

    def _straight_to(self, body: str, target: str) -> tuple[Array, Array, Array]:
        """Where a body is (3,), and the unit directions (3,) straight ahead to a target and to the left of that."""
        start_m = self._physics.position_m(body)
        ahead = (self._physics.position_m(target) - start_m) * [1.0, 1.0, 0.0]
        ahead /= np.linalg.norm(ahead)
        return start_m, ahead, np.cross(-DOWN, ahead)

    def _grasp(self, body: str, *, from_z_m: float, grasp_z_m: float, miss_m: float) -> Actions:
        resumes, self._resumes = self._resumes, False
        if resumes:
            self.has_resumed = True
            yield from self._resume(body, from_z_m, grasp_z_m)
            return
        yield from self.open()
        failed = self._begin_grasp()
        if failed is not None:
            yield from self._miss(body, from_z_m, grasp_z_m, miss_m * np.array(failed.offset))
        above = yield from self._reach_down(body, from_z_m, grasp_z_m)
        while self._watches and self._is_elsewhere(body, above):
            yield from self.move(above)
            above = yield from self._reach_down(body, from_z_m, grasp_z_m)
        yield from self.close()
        yield from self.move(above)

    def _begin_grasp(self) -> FailedGrasp | None:
        """Counts a grasp; returns how it is to fail first, or None."""
        failed, self.num_grasps = self._failed_grasp, self.num_grasps + 1
        return failed if failed is not None and failed.before == self.num_grasps - 1 else None

    def _reach_down(self, body: str, from_z_m: float, grasp_z_m: float) -> Generator[Action, None, Array]:
        """Brings the open fingers around a body; returns where it was taken to be: the tool waiting above it (4, 4)."""
        above = self._above_block(body, from_z_m, grasp_z_m)
        yield from self.open_at(above)
        while self._watches and self._is_elsewhere(body, above):
            above = self._above_block(body, from_z_m, grasp_z_m)
            yield from self.open_at(above)
        yield from self.move(at_height(above, grasp_z_m))
        return above

    def _is_elsewhere(self, body: str, above: Array) -> bool:
        """Whether a body has left the place below a transform (4, 4)."""
        return bool(np.linalg.norm(self._physics.position_m(body)[:2] - above[:2, 3]) > OVER_M)

    def _resume(self, body: str, from_z_m: float, grasp_z_m: float) -> Actions:
        """Continues a grasp that another controller has begun, well or badly."""
        self.num_grasps += 1
        here = self._physics.tcp_transform()
        if self._physics.is_grasped(body):
            yield from self.close()
            yield from self.move(at_height(here, from_z_m))
            return
        above = self._above_block(body, from_z_m, grasp_z_m)
        is_closed = self._gripper < 0
        is_empty = is_closed and float(np.min(self._physics.finger_openings_m())) < _EMPTY_M
        if is_over(here, above, grasp_z_m) and not is_empty:
            if here[2, 3] > grasp_z_m + OVER_Z_M:
                if is_closed:
                    yield from self.open()
                yield from self.move(at_height(above, grasp_z_m))
        else:
            if here[2, 3] < from_z_m - OVER_Z_M:
                yield from self.move(at_height(here, from_z_m))  # beside the thing there may be others
            if is_closed:
                yield from self.open()
            above = self._above_block(body, from_z_m, grasp_z_m)
            yield from self.open_at(above)
            yield from self.move(at_height(above, grasp_z_m))
        yield from self.close()
        yield from self.move(above)

    def _over_bar(self, end: str, onward: Sequence[Array]) -> tuple[Array, Array]:
        """Where the tool (4, 4) waits above a lying bar's end, and where it closes upon it: a way leads onward."""
        lying = transform(self._physics.pose(end))
        grasps = [put_at(facing_down(side * lying[:3, 1]), *lying[:3, 3]) for side in (-1.0, 1.0)]
        ways = [
            [at_height(grasp, height_m), grasp, at_height(grasp, height_m), *way]
            for height_m in _BAR_LIFTS_M
            for grasp in grasps
            for way in ways_of_carrying(lying, grasp, onward)
        ]
        above, grasp, *_ = self._first_way(ways)
        return above, grasp

    def _miss_bar(self, end: str, above: Array, grasp: Array, *, is_high: bool) -> Actions:
        """Closes above a bar, or beyond its end: beside it a finger would come down upon it. Comes up and opens."""
        outward = self._physics.position_m(end) - self._physics.position_m(end.split("/")[0])
        aside_m = np.array([0.0, 0.0, _MISS_M]) if is_high else _MISS_M * outward / np.linalg.norm(outward)
        missed, over = (put_at(pose, *(pose[:3, 3] + aside_m)) for pose in (grasp, above))
        for pose, grip in ((over, self.open), (missed, self.close), (over, self.open)):
            yield from self.move(pose)
            yield from grip()

    def _miss(self, body: str, from_z_m: float, grasp_z_m: float, offset_m: Array) -> Actions:
        """Grasps beside or above a body, comes back up and opens; the body may have been pushed by then."""
        above = self._above_block(body, from_z_m, grasp_z_m)
        above[:2, 3] += offset_m[:2]
        yield from self.open_at(above)
        yield from self.move(at_height(above, grasp_z_m + offset_m[2]))
        yield from self.close()
        yield from self.move(above)
        yield from self.open()

    def _stay_at(self, qpos: Array, num_steps: int) -> Actions:
        for _ in range(num_steps):
            yield self._action(qpos)

    def _tip_over(self, target: str) -> Array:
        """Tool pose (4, 4) at which the stick points at a target, with its current rotation."""
        x_m, y_m, _ = self._physics.position_m(target)
        return put_at(self._physics.tcp_transform(), x_m, y_m, _TIP_M)

    def _above_button(self, button: str) -> Array:
        """Where the tool waits above a button, fingers along y; the wrist is turned round if it must be."""
        x_m, y_m, _ = self._physics.position_m(button)
        return self._first_reachable([put_at(facing_down(side), x_m, y_m, _ABOVE_M) for side in (-LEFT, LEFT)])

    def _above_block(self, body: str, from_z_m: float, grasp_z_m: float) -> Array:
        """Where the tool waits above a square body, turned least among the grasps with most room for the open fingers.

        A square can be closed upon along four directions.
        """
        x_m, y_m, _ = self._physics.position_m(body)
        closing = self._physics.tcp_transform()[:3, 1]
        sides = [side for side in transform(self._physics.pose(body))[:3, :3].T if abs(side[2]) < _UPRIGHT]
        directions = sorted([*sides, *(-side for side in sides)], key=lambda side: -float(side @ closing))
        waiting = [put_at(facing_down(direction), x_m, y_m, from_z_m) for direction in directions]
        return self._first_reachable(sorted(waiting, key=lambda above: self._overlap_m(above, grasp_z_m, body)))

    def _overlap_m(self, above: Array, z_m: float, cube: str) -> float:
        """How deep open fingers that come down upon a cube would cut into what lies around it.

        It is 0 if the hand cannot get there: that is for `_first_reachable` to find out.
        """
        try:
            qpos = self._kinematics.solve(above, self._physics.arm_qpos())
            return self._kinematics.overlap_m(
                self._physics.data, self._kinematics.solve(at_height(above, z_m), qpos), cube
            )
        except UnreachableError:
            return 0.0

    def _carried_to(self, x_m: float, y_m: float, z_m: float) -> Array:
        """Tool pose (4, 4) at a place with its current rotation, or with quarter turns if the wrist cannot reach it."""
        held = self._physics.tcp_transform()
        quarters = [np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) for c, s in _QUARTERS]
        return self._first_reachable([put_at(T @ held, x_m, y_m, z_m) for T in quarters])

    def _first_reachable(self, targets: Sequence[Array]) -> Array:
        """The first transform (4, 4) that a straight screw from here leads to. Raises UnreachableError if none does."""
        return self._first_way([[target] for target in targets])[0]

    def _first_way(self, ways: Sequence[Sequence[Array]]) -> Sequence[Array]:
        """The first sequence of transforms (4, 4) that straight screws lead along. Raises UnreachableError if none.

        Ways on which a joint has to stop at its limit are looked at when all others have failed.
        """
        failures = []
        for stopping_at_limits in (False, True):
            for way in ways:
                qpos = self._physics.arm_qpos()
                try:
                    for target in way:
                        qpos = self._kinematics.screw_path(
                            qpos, target, _PATH_POINTS, stopping_at_limits=stopping_at_limits
                        )[-1]
                except UnreachableError as error:
                    failures.append(str(error))
                    continue
                return way
        raise UnreachableError("no straight way leads there: " + "; ".join(failures))

    def _action(self, qpos: Array) -> Action:
        return np.append(qpos, self._gripper).astype(np.float32)
