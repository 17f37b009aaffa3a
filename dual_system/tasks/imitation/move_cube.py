"""MoveCube: a video shows a cube brought to a target with a peg, with the closed gripper or in the hand; do as shown.

Between the video and the execution everything is drawn again: only the manner is the same. Source: RoboMME's MoveCube
at 598e3b4, rules restated. Difficulty changes nothing.

Kept from upstream on purpose: once the peg or the cube is in the hand, nothing can fail any more; and the peg may be
grasped at either end, though the script always takes the tail.

Not kept: upstream draws scenes until its planner solves one. Here the peg lies clear of the cube, of its way to the
target and of the hand that follows it, and the script comes down from above instead of slanting in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from dual_system.tasks import captions, predicates
from dual_system.tasks.geometry import Footprint, Spot, is_clear, pose
from dual_system.tasks.oracle import Motions
from dual_system.tasks.pegs import PEG_HALF_WIDTH_M, add_peg, peg_footprint
from dual_system.tasks.physics import Physics
from dual_system.tasks.placing import PlacedCube, Point, draw_cube, draw_disc, until_it_fits
from dual_system.tasks.props import PURPLE, TARGET_RADIUS_M, TARGET_THICKNESS_M, add_target
from dual_system.tasks.scene import SceneFullError, add_cube
from dual_system.tasks.task import Reasoning, Shown, Subtask, Task, task

MANNERS = {
    "hook": "hook it with the peg",
    "push": "push it with the closed gripper",
    "place": "pick it up and place it",
}

_DEMO_AREA_HALF_M, _AREA_HALF_M = 0.15, 0.1  # where the target may lie, in the video and in the execution
_CUBE_AREA_HALF_M, _CUBE_FROM_TARGET_M, _CUBE_JITTER_HALF_M = 0.1, 0.1, 0.05
_PEG_HALF_LENGTH_M, _PEG_RGBA = 0.1, (236 / 255, 115 / 255, 87 / 255, 1.0)
_PEG_Y_M, _PEG_JITTER_M, _PEG_YAW_RAD = 0.2, 0.05, np.pi / 4
_GAP_M, _CUBE_REACH_M, _HAND_BEHIND_M = 0.01, 0.03, 0.08
_PUSHED_M = 0.05  # half of the shortest way to the target: a cube that slips out of the fingers is not pushed
_CUBE, _TARGET, _PEG = "cube", "target", "peg"
_TAIL, _HEAD = f"{_PEG}/tail", f"{_PEG}/head"


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Initial poses of the objects, in the video or in the execution."""

    cube: PlacedCube
    target_xy_m: Point
    peg: Spot

    def put(self, physics: Physics) -> None:
        """Places everything."""
        self.cube.put(physics, _CUBE)
        physics.place(_TARGET, pose(*self.target_xy_m, TARGET_THICKNESS_M))
        physics.place(_PEG, self.peg.pose(PEG_HALF_WIDTH_M))


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One MoveCube episode; ``manner`` is one of MANNERS."""

    manner: str
    demonstrated: Scene
    asked: Scene


@task(family="imitation")
class MoveCube(Task[Layout, None]):
    """Move the cube to the target in the manner that the video shows."""

    retells_video = True

    def furnish(self, spec: mujoco.MjSpec) -> None:
        add_target(spec, _TARGET, PURPLE)
        add_cube(spec, _CUBE)
        add_peg(spec, _PEG, _PEG_HALF_LENGTH_M, _PEG_RGBA)

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        manner = str(rng.choice(list(MANNERS)))
        demonstrated = until_it_fits(lambda: _draw(rng, _DEMO_AREA_HALF_M))
        asked = until_it_fits(lambda: _draw(rng, _AREA_HALF_M))
        return Layout(manner=manner, demonstrated=demonstrated, asked=asked)

    def arrange(self, physics: Physics, layout: Layout) -> None:
        layout.demonstrated.put(physics)

    def instruction(self, layout: Layout) -> str:
        return "watch the video carefully, then move the cube to the target in the same manner as before"

    def subtasks(self, layout: Layout) -> tuple[Subtask, ...]:
        return _SUBTASKS[layout.manner]

    def demonstration(self, layout: Layout) -> tuple[Shown, ...]:
        shown = [Shown(text=step.text, grounds=step.grounds, motion=step.motion) for step in self.subtasks(layout)]
        num_static_steps = 30 if layout.manner == "hook" else 60
        return (
            *shown,
            Shown(text="static", motion=lambda motions: motions.wait(num_static_steps)),
            Shown(text="go home", motion=Motions.go_home, is_recorded=False, afterwards=layout.asked.put),
        )

    def reasoning(self, layout: Layout, index: int) -> Reasoning:
        with_peg = "the peg[ at <>], " if layout.manner == "hook" else ""
        return Reasoning(
            text=f"Demo sequence: {with_peg}the cube[ at <>], the target[ at <>]; modes: {MANNERS[layout.manner]}. "
            f"Reproduce exactly; next is: {captions.simple(self.subtasks(layout)[index].text)}.",
            grounds=(*([_TAIL] if with_peg else []), _CUBE, _TARGET),
        )

    def retold(self, layout: Layout) -> tuple[Layout, ...]:
        """The cube of the same video was moved in another manner."""
        return tuple(replace(layout, manner=manner) for manner in MANNERS if manner != layout.manner)

    def remember(self, memory: None, physics: Physics, layout: Layout) -> None:
        return None

    def first_choice(self, physics: Physics, memory: None, layout: Layout, index: int) -> bool | None:
        """The first manner that is begun is the shown one.

        It begins when the peg or the cube is picked, or when the cube is on the target or 5 cm away from where it lay
        while the gripper is not open.
        """
        start, at_m = layout.asked.cube, physics.position_m(_CUBE)
        moved_m = float(np.hypot(at_m[0] - start.x_m, at_m[1] - start.y_m))
        if picked := predicates.first_picked(physics, (_TAIL, _HEAD, _CUBE)):
            begun = "place" if picked == _CUBE else "hook"
        elif (moved_m > _PUSHED_M and not predicates.is_gripper_open(physics)) or predicates.is_pushed_onto(
            physics, _CUBE, _TARGET
        ):
            begun = "push"
        else:
            return None
        return begun == layout.manner


def _draw(rng: np.random.Generator, area_half_m: float) -> Scene:
    target_xy_m = draw_disc(
        rng, radius_m=TARGET_RADIUS_M, center_m=(0.0, 0.0), half_m=(area_half_m, area_half_m), obstacles=(), gap_m=0.0
    )
    center_m = rng.uniform(-_CUBE_AREA_HALF_M, _CUBE_AREA_HALF_M, 2)
    if np.hypot(*(center_m - target_xy_m)) <= _CUBE_FROM_TARGET_M:
        raise SceneFullError("the cube would lie next to the target. Draw the scene again.")
    cube = draw_cube(
        rng,
        "red",
        center_m=(float(center_m[0]), float(center_m[1])),
        half_m=(_CUBE_JITTER_HALF_M, _CUBE_JITTER_HALF_M),
        obstacles=(),
        gap_m=0.0,
    )
    side = float(rng.choice((-1.0, 1.0)))
    x_m, y_m = rng.uniform(-_PEG_JITTER_M, _PEG_JITTER_M, 2).tolist()
    peg = Spot(x_m=x_m, y_m=side * _PEG_Y_M + y_m, yaw_rad=float(rng.uniform(-_PEG_YAW_RAD, _PEG_YAW_RAD)))
    if not is_clear(peg_footprint(peg, _PEG_HALF_LENGTH_M), _way_of((cube.x_m, cube.y_m), target_xy_m), _GAP_M):
        raise SceneFullError("the peg would lie in the cube's way. Draw the scene again.")
    return Scene(cube=cube, target_xy_m=target_xy_m, peg=peg)


def _way_of(cube_xy_m: Point, target_xy_m: Point) -> Footprint:
    """The area of the table that cube and hand cover from before the first push to the last."""
    way_m = np.subtract(target_xy_m, cube_xy_m)
    length_m = float(np.linalg.norm(way_m))
    first_m, last_m = -_HAND_BEHIND_M / length_m, 1.0 + _CUBE_REACH_M / length_m
    center_m = cube_xy_m + way_m * (first_m + last_m) / 2
    return Footprint(
        center_m=(float(center_m[0]), float(center_m[1])),
        half_m=(length_m * (last_m - first_m) / 2, _CUBE_REACH_M),
        yaw_rad=float(np.arctan2(way_m[1], way_m[0])),
    )


def _is_on_target(physics: Physics, memory: None) -> bool:
    return predicates.is_pushed_onto(physics, _CUBE, _TARGET) and predicates.is_gripper_open(physics)


def _fails_with(*picked: str, on_target: bool = False) -> Callable[[Physics, None], str | None]:
    """The failure of picking something up, and of the cube being on the target before anything was taken in hand."""

    def failure(physics: Physics, memory: None) -> str | None:
        name = predicates.first_picked(physics, picked)
        if name is not None:
            return f"picked up the {name.split('/')[0]}; the video shows another manner"
        if on_target and predicates.is_pushed_onto(physics, _CUBE, _TARGET):
            return "the cube was on the target before anything was picked up; the video shows another manner"
        return None

    return failure


_SUBTASKS: dict[str, tuple[Subtask, ...]] = {
    "hook": (
        Subtask(
            text="Pick up the peg[ at <>]",
            grounds=(_TAIL,),
            is_done=lambda physics, memory: predicates.first_picked(physics, (_TAIL, _HEAD)) is not None,
            failure=_fails_with(_CUBE, on_target=True),
            motion=lambda motions: motions.pick_bar(_TAIL, onward=motions.hooking(_CUBE, _TARGET)),
        ),
        Subtask(
            text="Hook the cube[ at <>] to the target[ at <>] with the peg",
            grounds=(_CUBE, _TARGET),
            is_done=_is_on_target,
            motion=lambda motions: motions.hook(_TAIL, _CUBE, _TARGET),
        ),
    ),
    "push": (
        Subtask(
            text="Close the gripper and push the cube[ at <>] to the target[ at <>]",
            grounds=(_CUBE, _TARGET),
            is_done=_is_on_target,
            failure=_fails_with(_CUBE, _TAIL, _HEAD),
            motion=lambda motions: motions.push(_CUBE, _TARGET),
        ),
    ),
    "place": (
        Subtask(
            text="Pick up the cube[ at <>]",
            grounds=(_CUBE,),
            is_done=lambda physics, memory: predicates.is_picked(physics, _CUBE),
            failure=_fails_with(_TAIL, _HEAD, on_target=True),
            motion=lambda motions: motions.pick(_CUBE),
        ),
        Subtask(
            text="place the cube onto the target[ at <>]",
            grounds=(_TARGET,),
            is_done=lambda physics, memory: predicates.is_dropped_onto(physics, _CUBE, _TARGET),
            motion=lambda motions: motions.place(_TARGET),
            carries=(_CUBE,),
        ),
    ),
}
