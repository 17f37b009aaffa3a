"""PickXtimes: pick up a cube and place it on the target exactly a given number of times; then press the button.

Source: RoboMME's PickXtimes at 598e3b4, rules restated.

The order is kept by the list of subtasks alone, so there is no memory. Once too many is one pick in the last stage:
upstream does not check whether the cube is placed again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from dual_system.tasks import captions, predicates
from dual_system.tasks.geometry import pose
from dual_system.tasks.physics import Physics
from dual_system.tasks.placing import PlacedCube, draw_button, draw_cube, draw_disc, until_it_fits
from dual_system.tasks.props import PURPLE, TARGET_RADIUS_M, TARGET_THICKNESS_M, add_target
from dual_system.tasks.scene import CUBE_COLORS, add_button, add_cube
from dual_system.tasks.task import Reasoning, Subtask, Task, task

_NUM_CUBES = {"easy": 1, "medium": 3, "hard": 3}
_REPEATS = {"easy": (1, 3), "medium": (1, 3), "hard": (4, 5)}  # both ends included
_CENTER_M, _HALF_M = (-0.1, 0.0), (0.2, 0.2)
_CUBE_GAP_M, _TARGET_GAP_M = 0.02, 0.04
_BUTTON, _TARGET = "button", "target"
_CUBES = tuple(f"cube_{i}" for i in range(max(_NUM_CUBES.values())))


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One PickXtimes scene; ``asked`` is the index of the cube to pick."""

    button_xy_m: tuple[float, float]
    cubes: tuple[PlacedCube, ...]  # each of another color
    target_xy_m: tuple[float, float]
    asked: int
    repeats: int


@task(family="counting")
class PickXtimes(Task[Layout, None]):
    """Pick and place one cube a given number of times, then press the button."""

    repeats_itself = True

    def furnish(self, spec: mujoco.MjSpec) -> None:
        add_button(spec, _BUTTON)
        add_target(spec, _TARGET, PURPLE)
        for cube in _CUBES:
            add_cube(spec, cube)

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        return until_it_fits(lambda: _draw(rng, difficulty))

    def arrange(self, physics: Physics, layout: Layout) -> None:
        physics.place(_BUTTON, pose(*layout.button_xy_m, 0.0))
        physics.place(_TARGET, pose(*layout.target_xy_m, TARGET_THICKNESS_M))
        for name, cube in zip(_CUBES, layout.cubes, strict=False):
            cube.put(physics, name)

    def instruction(self, layout: Layout) -> str:
        color = layout.cubes[layout.asked].color
        times = f", repeating this action {captions.COUNTS[layout.repeats - 1]} times" if layout.repeats > 1 else ""
        return f"pick up the {color} cube and place it on the target{times}, then press the button to stop"

    def subtasks(self, layout: Layout) -> tuple[Subtask, ...]:
        cube, color = _CUBES[layout.asked], layout.cubes[layout.asked].color
        early = _too_early(layout)
        steps = []
        for nth in captions.ORDINALS[: layout.repeats]:
            steps += [
                Subtask(
                    text=f"pick up the {color} cube[ at <>] for the {nth} time",
                    grounds=(cube,),
                    is_done=lambda physics, memory: predicates.is_picked(physics, cube),
                    failure=early,
                    motion=lambda motions: motions.pick(cube),
                ),
                Subtask(
                    text=f"place the {color} cube onto the target[ at <>]",
                    grounds=(_TARGET,),
                    is_done=lambda physics, memory: predicates.is_dropped_onto(physics, cube, _TARGET),
                    failure=early,
                    motion=lambda motions: motions.place(_TARGET),
                    carries=(cube,),
                ),
            ]
        steps.append(
            Subtask(
                text="press the button[ at <>] to stop",
                grounds=(f"{_BUTTON}/cap",),
                is_done=lambda physics, memory: predicates.is_pressed(physics, _BUTTON),
                failure=_once_too_many(layout),
                motion=lambda motions: motions.press(_BUTTON),
            )
        )
        return tuple(steps)

    def reasoning(self, layout: Layout, index: int) -> Reasoning:
        color, done = layout.cubes[layout.asked].color, min(index // 2, layout.repeats)
        count = f"Target: {layout.repeats}; completed: {done}; remaining: {layout.repeats - done}. "
        if done == layout.repeats:
            return Reasoning(text=count + "Next, press the button[ at <>].", grounds=(f"{_BUTTON}/cap",))
        text = count + f"Next, move the {color} cube[ at <>] to the target[ at <>]."
        return Reasoning(text=text, grounds=(_CUBES[layout.asked], _TARGET))

    def remember(self, memory: None, physics: Physics, layout: Layout) -> None:
        return None

    def first_choice(self, physics: Physics, memory: None, layout: Layout, index: int) -> bool | None:
        """The button is pressed after exactly so many rounds, not earlier, and the cube is not picked once more."""
        are_done = index == 2 * layout.repeats
        if predicates.is_pressed(physics, _BUTTON):
            return are_done
        return False if are_done and predicates.is_picked(physics, _CUBES[layout.asked]) else None


def _draw(rng: np.random.Generator, difficulty: str) -> Layout:
    button = draw_button(rng)
    cubes: list[PlacedCube] = []
    for color in rng.permutation(list(CUBE_COLORS))[: _NUM_CUBES[difficulty]]:
        taken = [button, *(cube.footprint for cube in cubes)]
        cubes.append(draw_cube(rng, str(color), center_m=_CENTER_M, half_m=_HALF_M, obstacles=taken, gap_m=_CUBE_GAP_M))
    target_xy_m = draw_disc(
        rng,
        radius_m=TARGET_RADIUS_M,
        center_m=_CENTER_M,
        half_m=_HALF_M,
        obstacles=[button, *(cube.footprint for cube in cubes)],
        gap_m=_TARGET_GAP_M,
    )
    return Layout(
        button_xy_m=button.center_m,
        cubes=tuple(cubes),
        target_xy_m=target_xy_m,
        asked=int(rng.integers(len(cubes))),
        repeats=int(rng.integers(*_REPEATS[difficulty], endpoint=True)),
    )


def _too_early(layout: Layout) -> Callable[[Physics, None], str | None]:
    """The failure of every stage but the last: another cube is picked, or the button is pressed."""
    others = [name for i, name in enumerate(_CUBES[: len(layout.cubes)]) if i != layout.asked]

    def failure(physics: Physics, memory: None) -> str | None:
        wrong = predicates.first_picked(physics, others)
        if wrong is not None:
            return f"picked up {wrong}, a {layout.cubes[_CUBES.index(wrong)].color} cube that was not asked for"
        if predicates.is_pressed(physics, _BUTTON):
            return f"pressed the button before {layout.repeats} rounds were done"
        return None

    return failure


def _once_too_many(layout: Layout) -> Callable[[Physics, None], str | None]:
    def failure(physics: Physics, memory: None) -> str | None:
        picked = predicates.first_picked(physics, _CUBES[: len(layout.cubes)])
        return None if picked is None else f"picked up {picked} when all rounds were done ({layout.repeats})"

    return failure
