"""PickHighlight: which cubes were lit up for a moment, while the robot was busy with a button?

White discs lie under the target cubes from step 10 to step 100 and never again. They follow the step clock: whether the
button has been pressed by then makes no difference. Source: RoboMME's PickHighlight at 598e3b4, rules restated.

Kept from upstream on purpose: the episode is a success as soon as every target has been lifted once, in any order,
even if the button was never pressed; and lifting a wrong cube fails only once the button has been pressed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import mujoco
import numpy as np

from dual_system.tasks import captions, predicates
from dual_system.tasks.geometry import pose
from dual_system.tasks.oracle import Actions, Motions
from dual_system.tasks.physics import Physics
from dual_system.tasks.placing import PlacedCube, draw_button, draw_cube, until_it_fits
from dual_system.tasks.scene import CUBE_COLORS, add_button, add_cube, add_disc
from dual_system.tasks.task import Reasoning, Subtask, Task, task

HIGHLIGHT_STEPS = range(10, 101)  # the observations that show the discs

_NUM_CUBES = {"easy": 3, "medium": 4, "hard": 6}
_NUM_TARGETS = {"easy": 1, "medium": 2, "hard": 3}
_CUBES_CENTER_M, _CUBES_HALF_M = (-0.1, 0.0), (0.2, 0.2)
_GAP_M = 0.04
_DISC_BELOW_CENTER_M = 0.01  # the cube hides its middle; a ring of 2 cm shows
_RELEASE_Z_M = 0.01
_BUTTON = "button"
_CUBES = tuple(f"cube_{i}" for i in range(max(_NUM_CUBES.values())))
_DISCS = tuple(f"highlight_{i}" for i in range(max(_NUM_TARGETS.values())))


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One PickHighlight scene; ``targets`` are indices into ``cubes``, in the order the oracle picks them."""

    button_xy_m: tuple[float, float]
    cubes: tuple[PlacedCube, ...]
    targets: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """The cubes that have ever been lifted, and those that are lifted now."""

    ever_picked: frozenset[str]
    picked_now: frozenset[str]


@task(family="reference")
class PickHighlight(Task[Layout, Memory]):
    """Press the button, then pick up the cubes that were highlighted."""

    def furnish(self, spec: mujoco.MjSpec) -> None:
        add_button(spec, _BUTTON)
        for cube in _CUBES:
            add_cube(spec, cube)
        for disc in _DISCS:
            add_disc(spec, disc)

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        return until_it_fits(lambda: _draw(rng, difficulty))

    def arrange(self, physics: Physics, layout: Layout) -> None:
        physics.place(_BUTTON, pose(*layout.button_xy_m, 0.0))
        for name, cube in zip(_CUBES, layout.cubes, strict=False):
            cube.put(physics, name)

    def stage(self, physics: Physics, layout: Layout, memory: Memory | None, step: int) -> None:
        for disc, target in zip(_DISCS, layout.targets, strict=False):
            if step in HIGHLIGHT_STEPS:
                x_m, y_m, z_m = physics.position_m(_CUBES[target])
                physics.place(disc, pose(x_m, y_m, z_m - _DISC_BELOW_CENTER_M))
            else:
                physics.park(disc)
        physics.refresh()

    def instruction(self, layout: Layout) -> str:
        return (
            "first press the button, then pick up all cubes that have been highlighteted with white areas on the table"
        )

    def subtasks(self, layout: Layout) -> tuple[Subtask, ...]:
        wrong = tuple(name for i, name in enumerate(_CUBES[: len(layout.cubes)]) if i not in layout.targets)
        failure = partial(_wrong_pick, layout, wrong)
        steps = [
            Subtask(
                text="press the button[ at <>]",
                grounds=(f"{_BUTTON}/cap",),
                is_done=lambda physics, memory: predicates.is_pressed(physics, _BUTTON),
                motion=lambda motions: motions.press(_BUTTON),
            )
        ]
        for nth, target in enumerate(layout.targets):
            if nth > 0:
                steps.append(
                    Subtask(
                        text="place the cube onto the table",
                        is_done=_is_dropped(_CUBES[layout.targets[nth - 1]]),
                        failure=failure,
                        motion=lambda motions: motions.put_down(_RELEASE_Z_M),
                    )
                )
            ordinal = f"{captions.ORDINALS[nth]} " if len(layout.targets) > 1 else ""
            steps.append(
                Subtask(
                    text=f"pick up the {ordinal}highlighted cube[ at <>], which is {layout.cubes[target].color}",
                    grounds=(_CUBES[target],),
                    is_done=_is_picked(_CUBES[target]),
                    failure=failure,
                    motion=_pick(_CUBES[target]),
                )
            )
        return tuple(steps)

    def reasoning(self, layout: Layout, index: int) -> Reasoning | None:
        if index == 0:
            return None  # pressing the button asks for nothing seen before
        num_chosen = index // 2  # one that is being put down counts
        chosen = (*layout.targets, layout.targets[num_chosen])
        *marked, next_one = (f"the {layout.cubes[target].color} cube[ at <>]" for target in chosen)
        text = f"Highlighted: {', '.join(marked)}; after {num_chosen} of {len(marked)}, choose {next_one}."
        return Reasoning(text=text, grounds=tuple(_CUBES[target] for target in chosen))

    def retold(self, layout: Layout) -> tuple[Layout, ...]:
        others = [index for index in range(len(layout.cubes)) if index not in layout.targets]
        return tuple(replace(layout, targets=lit) for lit in combinations(others, len(layout.targets)))

    def cues(self, layout: Layout) -> tuple[str, ...]:
        return _DISCS[: len(layout.targets)]

    def remember(self, memory: Memory | None, physics: Physics, layout: Layout) -> Memory:
        now = frozenset(name for name in _CUBES[: len(layout.cubes)] if predicates.is_picked(physics, name))
        return Memory(ever_picked=now | (memory.ever_picked if memory else frozenset()), picked_now=now)

    def first_choice(self, physics: Physics, memory: Memory, layout: Layout, index: int) -> bool | None:
        """The first cube that is picked was lit, whether the button was pressed before or not."""
        lit = {_CUBES[target] for target in layout.targets}
        return memory.picked_now <= lit if memory.picked_now else None

    def is_accomplished(self, memory: Memory, layout: Layout) -> bool:
        return all(_CUBES[target] in memory.ever_picked for target in layout.targets)


def _draw(rng: np.random.Generator, difficulty: str) -> Layout:
    button = draw_button(rng)
    cubes: list[PlacedCube] = []
    for _ in range(_NUM_CUBES[difficulty]):
        color = str(rng.choice(list(CUBE_COLORS)))
        taken = [button, *(cube.footprint for cube in cubes)]
        cubes.append(
            draw_cube(rng, color, center_m=_CUBES_CENTER_M, half_m=_CUBES_HALF_M, obstacles=taken, gap_m=_GAP_M)
        )
    targets = rng.permutation(len(cubes))[: _NUM_TARGETS[difficulty]]
    return Layout(button_xy_m=button.center_m, cubes=tuple(cubes), targets=tuple(int(i) for i in targets))


def _wrong_pick(layout: Layout, wrong: tuple[str, ...], physics: Physics, memory: Memory) -> str | None:
    for name in wrong:
        if name in memory.picked_now:
            return f"picked up {name}, a {layout.cubes[_CUBES.index(name)].color} cube that was not highlighted"
    return None


def _is_picked(cube: str) -> Callable[[Physics, Memory], bool]:
    return lambda physics, memory: cube in memory.picked_now


def _is_dropped(cube: str) -> Callable[[Physics, Memory], bool]:
    return lambda physics, memory: predicates.is_dropped(physics, cube)


def _pick(cube: str) -> Callable[[Motions], Actions]:
    return lambda motions: motions.pick(cube)
