"""SwingXtimes: carry a cube to and fro between two targets a given number of times, put it down, press the button.

A target turns red while the cube is over it and for 20 steps after. Every arrival of the cube over a target counts, and
more than two per round is a failure. Source: RoboMME's SwingXtimes at 598e3b4, rules restated.

"Right" and "left" are the robot's: right is towards smaller y, and on the left of the front camera's picture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from dual_system.tasks import captions, predicates
from dual_system.tasks.geometry import pose
from dual_system.tasks.oracle import Actions, Motions
from dual_system.tasks.physics import Physics
from dual_system.tasks.placing import PlacedCube, draw_button, draw_cube, draw_disc, until_it_fits
from dual_system.tasks.props import GRAY, RED, TARGET_RADIUS_M, TARGET_THICKNESS_M, add_target
from dual_system.tasks.scene import CUBE_COLORS, add_button, add_cube
from dual_system.tasks.task import Reasoning, Subtask, Task, task

RED_STEPS = 20

_NUM_CUBES = {"easy": 1, "medium": 3, "hard": 3}
_REPEATS = {"easy": (1, 3), "medium": (1, 2), "hard": (3, 3)}  # both ends included
_CUBES_CENTER_M, _CUBES_HALF_M = (-0.1, 0.0), (0.25, 0.25)
_TARGET_CENTERS_M, _TARGET_HALF_M = {"right": (-0.1, -0.2), "left": (-0.1, 0.2)}, (0.1, 0.1)
_GAP_M = 0.02
_ENTER_M, _ENTER_Z_M = 0.03, 0.12
_LEAVE_M, _LEAVE_Z_M = 0.04, 0.3  # laxer, so that a trembling hand does not count twice
_RELEASE_Z_M = 0.07
_RED_RADIUS_M, _RED_HALF_HEIGHT_M, _RED_BELOW_M = TARGET_RADIUS_M * 1.003, 0.014, 0.01
_SIDES = ("right", "left")
_BUTTON = "button"
_CUBES = tuple(f"cube_{i}" for i in range(max(_NUM_CUBES.values())))


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One SwingXtimes scene; ``asked`` is the index of the cube to carry, targets are by side."""

    button_xy_m: tuple[float, float]
    cubes: tuple[PlacedCube, ...]  # each of another color
    right_xy_m: tuple[float, float]
    left_xy_m: tuple[float, float]
    asked: int
    repeats: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Visit:
    """How the cube stands to one target."""

    is_over: bool = False
    num_arrivals: int = 0
    steps_since: int | None = None  # since the cube was last over it; 0 while it is, None before it ever was


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """The cube's visits to both targets."""

    right: Visit
    left: Visit


@task(family="counting")
class SwingXtimes(Task[Layout, Memory]):
    """Swing one cube between two targets a given number of times, put it down, then press the button."""

    repeats_itself = True

    def furnish(self, spec: mujoco.MjSpec) -> None:
        add_button(spec, _BUTTON)
        for side in _SIDES:
            add_target(spec, _target(side), GRAY)
            add_target(spec, _red(side), RED, radius_m=_RED_RADIUS_M, half_height_m=_RED_HALF_HEIGHT_M)
        for cube in _CUBES:
            add_cube(spec, cube)

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        return until_it_fits(lambda: _draw(rng, difficulty))

    def arrange(self, physics: Physics, layout: Layout) -> None:
        physics.place(_BUTTON, pose(*layout.button_xy_m, 0.0))
        physics.place(_target("right"), pose(*layout.right_xy_m, TARGET_THICKNESS_M))
        physics.place(_target("left"), pose(*layout.left_xy_m, TARGET_THICKNESS_M))
        for name, cube in zip(_CUBES, layout.cubes, strict=False):
            cube.put(physics, name)

    def stage(self, physics: Physics, layout: Layout, memory: Memory | None, step: int) -> None:
        for side, visit in (("right", memory.right), ("left", memory.left)) if memory else ():
            if visit.steps_since is not None and visit.steps_since <= RED_STEPS:
                x_m, y_m, z_m = physics.position_m(_target(side))
                physics.place(_red(side), pose(x_m, y_m, z_m - _RED_BELOW_M))
            else:
                physics.park(_red(side))
        physics.refresh()

    def instruction(self, layout: Layout) -> str:
        begin = (
            f"pick up the {layout.cubes[layout.asked].color} cube, move it to the top of the right-side target, then "
        )
        if layout.repeats == 1:
            return begin + "put it down on the left-side target, finally press the button to stop"
        times = captions.COUNTS[layout.repeats - 1]
        return begin + (
            "move it to the top of the left-side target, "
            f"repeating this back-and-forth motion {times} times, finally press the button to stop"
        )

    def subtasks(self, layout: Layout) -> tuple[Subtask, ...]:
        cube, color = _CUBES[layout.asked], layout.cubes[layout.asked].color
        failure = _mishap(layout, may_press=False)
        swings = [
            Subtask(
                text=f"move to the top of the {side}-side target[ at <>] for the {nth} time",
                grounds=(_target(side),),
                is_done=_is_over(cube, side),
                failure=failure,
                motion=_swing_over(side),
                carries=(cube,),
            )
            for nth in captions.ORDINALS[: layout.repeats]
            for side in _SIDES
        ]
        return (
            Subtask(
                text=f"pick up the {color} cube[ at <>]",
                grounds=(cube,),
                is_done=lambda physics, memory: predicates.is_picked(physics, cube),
                failure=failure,
                motion=lambda motions: motions.pick(cube),
            ),
            *swings,
            Subtask(
                text=f"put the {color} cube on the table",
                is_done=lambda physics, memory: predicates.is_dropped(physics, cube),
                failure=failure,
                motion=lambda motions: motions.put_down(_RELEASE_Z_M),
            ),
            Subtask(
                text="press the button[ at <>]",
                grounds=(f"{_BUTTON}/cap",),
                is_done=lambda physics, memory: predicates.is_pressed(physics, _BUTTON),
                failure=_mishap(layout, may_press=True),
                motion=lambda motions: motions.press(_BUTTON),
            ),
        )

    def reasoning(self, layout: Layout, index: int) -> Reasoning:
        swings, color = index - 1, layout.cubes[layout.asked].color
        done = min(max(swings, 0) // 2, layout.repeats)
        count = f"Target: {layout.repeats}; completed: {done}; remaining: {layout.repeats - done}. "
        if done == layout.repeats:
            is_held = swings == 2 * layout.repeats
            text, ground = (
                (f"Next, put the {color} cube[ at <>] on the table.", _CUBES[layout.asked])
                if is_held
                else ("Next, press the button[ at <>].", f"{_BUTTON}/cap")
            )
            return Reasoning(text=count + text, grounds=(ground,))
        side = _SIDES[max(swings, 0) % 2]
        text = count + f"Next, move the {color} cube[ at <>] to the {side}-side target[ at <>]."
        return Reasoning(text=text, grounds=(_CUBES[layout.asked], _target(side)))

    def remember(self, memory: Memory | None, physics: Physics, layout: Layout) -> Memory:
        before = memory or Memory(right=Visit(), left=Visit())
        cube = _CUBES[layout.asked]
        return Memory(
            right=_follow(before.right, physics, cube, "right"), left=_follow(before.left, physics, cube, "left")
        )

    def first_choice(self, physics: Physics, memory: Memory, layout: Layout, index: int) -> bool | None:
        """The button is pressed after exactly so many rounds, put down or not, and the cube swings to no other side."""
        if memory.right.num_arrivals + memory.left.num_arrivals > 2 * layout.repeats:
            return False
        return index > 2 * layout.repeats if predicates.is_pressed(physics, _BUTTON) else None


def _draw(rng: np.random.Generator, difficulty: str) -> Layout:
    button = draw_button(rng)
    cubes: list[PlacedCube] = []
    for color in rng.permutation(list(CUBE_COLORS))[: _NUM_CUBES[difficulty]].tolist():
        taken = [button, *(cube.footprint for cube in cubes)]
        cubes.append(
            draw_cube(rng, color, center_m=_CUBES_CENTER_M, half_m=_CUBES_HALF_M, obstacles=taken, gap_m=_GAP_M)
        )
    taken = [button, *(cube.footprint for cube in cubes)]
    right_xy_m, left_xy_m = (
        draw_disc(
            rng,
            radius_m=TARGET_RADIUS_M,
            center_m=_TARGET_CENTERS_M[side],
            half_m=_TARGET_HALF_M,
            obstacles=taken,  # the two regions are so far apart that the targets cannot meet
            gap_m=_GAP_M,
        )
        for side in _SIDES
    )
    return Layout(
        button_xy_m=button.center_m,
        cubes=tuple(cubes),
        right_xy_m=right_xy_m,
        left_xy_m=left_xy_m,
        asked=int(rng.integers(len(cubes))),
        repeats=int(rng.integers(*_REPEATS[difficulty], endpoint=True)),
    )


def _target(side: str) -> str:
    return f"target_{side}"


def _red(side: str) -> str:
    return f"red_{side}"


def _follow(visit: Visit, physics: Physics, cube: str, side: str) -> Visit:
    within_m, below_z_m = (_LEAVE_M, _LEAVE_Z_M) if visit.is_over else (_ENTER_M, _ENTER_Z_M)
    is_over = predicates.is_over(physics, cube, _target(side), within_m=within_m, below_z_m=below_z_m)
    since = 0 if is_over else None if visit.steps_since is None else visit.steps_since + 1
    return Visit(is_over=is_over, num_arrivals=visit.num_arrivals + (is_over and not visit.is_over), steps_since=since)


def _is_over(cube: str, side: str) -> Callable[[Physics, Memory], bool]:
    return lambda physics, memory: predicates.is_over(
        physics, cube, _target(side), within_m=_ENTER_M, below_z_m=_ENTER_Z_M
    )


def _swing_over(side: str) -> Callable[[Motions], Actions]:
    return lambda motions: motions.swing_over(_target(side))


def _mishap(layout: Layout, *, may_press: bool) -> Callable[[Physics, Memory], str | None]:
    others = [name for i, name in enumerate(_CUBES[: len(layout.cubes)]) if i != layout.asked]

    def failure(physics: Physics, memory: Memory) -> str | None:
        wrong = predicates.first_picked(physics, others)
        if wrong is not None:
            return f"picked up {wrong}, a {layout.cubes[_CUBES.index(wrong)].color} cube that was not asked for"
        if not may_press and predicates.is_pressed(physics, _BUTTON):
            return "pressed the button before the cube was put down"
        num_arrivals = memory.right.num_arrivals + memory.left.num_arrivals
        if num_arrivals > 2 * layout.repeats:
            return f"came over a target {num_arrivals} times; {layout.repeats} rounds take {2 * layout.repeats}"
        return None

    return failure
