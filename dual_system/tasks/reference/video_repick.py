"""VideoRepick: a cube is picked up in a video; pick it up again, a given number of times, then press the button.

Cubes look alike. Where the scene is easy or medium there are three, and they change places before the video ends; where
it is hard there are fifteen, five of each colour, and none moves. Source: RoboMME's VideoRepick at 598e3b4, rules
restated.

Kept from upstream on purpose: pressing the button too early is a failure only from 50 to 500 steps after picking up, or
putting down, was first asked for. Which of the two counts is the one that is asked for now.

Not kept: who swaps with whom is settled by where the cubes are first laid. Upstream looks when the swap begins, which
differs only if the cube that was put down again has a nearly equidistant choice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from dual_system.tasks import captions, predicates, swaps
from dual_system.tasks.geometry import Spot, pose
from dual_system.tasks.oracle import Actions, Motions
from dual_system.tasks.physics import Physics
from dual_system.tasks.placing import (
    BUTTON_ROOM_HALF_M,
    PlacedCube,
    draw_button,
    draw_cube,
    draw_threesome,
    has_finger_room,
    is_in_reach,
    turned_at_random,
    until_it_fits,
)
from dual_system.tasks.reference import shuffle
from dual_system.tasks.reference.shuffle import Rest
from dual_system.tasks.scene import CUBE_COLORS, CUBE_HALF_M, SceneFullError, add_button, add_cube
from dual_system.tasks.swaps import SWAP_STEPS, Swap
from dual_system.tasks.task import Reasoning, Shown, Subtask, Task, task

EARLY_STEPS = range(50, 501)  # how long ago the task must have been set for a press to be too early
LANE_M = 0.07

_SWAPS = {"easy": (1, 2), "medium": (2, 3)}  # both ends included
_REPEATS = (1, 3)
_CUBES_PER_COLOR = 5
_CLUTTER_CENTER_M, _CLUTTER_HALF_M = (-0.1, 0.0), (0.2, 0.25)
_JITTER_HALF_M = (0.07, 0.07)
_GAP_M = 0.02
_BUTTON_CENTER_M, _BUTTON_REACH_M = (-0.2, 0.0), (0.05, 0.05)
_SHOWN_RELEASE_Z_M, _RELEASE_Z_M = 0.03, 0.01
_BUTTON = "button"
_CUBES = tuple(f"cube_{i}" for i in range(_CUBES_PER_COLOR * len(CUBE_COLORS)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One VideoRepick scene; ``asked`` is the index of the cube that the video shows."""

    button_xy_m: tuple[float, float]
    cubes: tuple[PlacedCube, ...]
    asked: int
    repeats: int
    swaps: tuple[Swap, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """The arm's rest in the demonstration, and how many steps ago either kind of subtask was first set."""

    rest: Rest | None
    picking_steps: int
    putting_steps: int | None  # None until the cube has been picked up
    has_picked: bool


@task(family="reference")
class VideoRepick(Task[Layout, Memory]):
    """Pick up the cube that was picked up in the video, a given number of times, then press the button."""

    retells_video = True

    def furnish(self, spec: mujoco.MjSpec) -> None:
        add_button(spec, _BUTTON)
        for cube in _CUBES:
            add_cube(spec, cube)

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        return until_it_fits(lambda: _draw(rng, difficulty))

    def arrange(self, physics: Physics, layout: Layout) -> None:
        physics.place(_BUTTON, pose(*layout.button_xy_m, 0.0))
        for name, cube in zip(_CUBES, layout.cubes, strict=False):
            cube.put(physics, name)

    def stage(self, physics: Physics, layout: Layout, memory: Memory | None, step: int) -> None:
        rest = memory.rest if memory else None
        shuffle.move(physics, rest, _names(layout), layout.swaps, step=step, lane_m=LANE_M, z_m=CUBE_HALF_M)

    def instruction(self, layout: Layout) -> str:
        if layout.repeats == 1:
            again = "pick up the same block that was previously picked up again"
        else:
            times = captions.COUNTS[layout.repeats - 1]
            again = f"repeatedly pick up and put down the same block that was previously picked up for {times} times"
        return f"watch the video carefully, then {again}, finally put it down and press the button to stop"

    def demonstration(self, layout: Layout) -> tuple[Shown, ...]:
        cube = _CUBES[layout.asked]
        parts = [
            Shown(text="pick up the cube[ at <>]", grounds=(cube,), motion=_pick(cube)),
            Shown(text="drop the cube on the table", motion=_put_down(_SHOWN_RELEASE_Z_M)),
        ]
        if layout.swaps:
            parts.append(Shown(text="static", motion=shuffle.rest))
            parts += [Shown(text="static", motion=lambda motions: motions.wait(SWAP_STEPS)) for _ in layout.swaps]
        parts.append(Shown(text="NO RECORD", motion=lambda motions: motions.go_home(), is_recorded=False))
        return tuple(parts)

    def subtasks(self, layout: Layout) -> tuple[Subtask, ...]:
        cube = _CUBES[layout.asked]
        steps = []
        for nth in captions.ORDINALS[: layout.repeats]:
            steps += [
                Subtask(
                    text=f"pick up the correct cube[ at <>] for the {nth} time",
                    grounds=(cube,),
                    is_done=lambda physics, memory: predicates.is_picked(physics, cube),
                    failure=_mishap(layout, lambda memory: memory.picking_steps),
                    motion=_pick(cube),
                ),
                Subtask(
                    text="put it down",
                    is_done=lambda physics, memory: predicates.is_dropped(physics, cube),
                    failure=_mishap(layout, lambda memory: memory.putting_steps),
                    motion=_put_down(_RELEASE_Z_M),
                ),
            ]
        steps.append(
            Subtask(
                text="press the button[ at <>] to finish",
                grounds=(f"{_BUTTON}/cap",),
                is_done=lambda physics, memory: predicates.is_pressed(physics, _BUTTON),
                failure=_once_too_many(layout),
                motion=lambda motions: motions.press(_BUTTON),
            )
        )
        return tuple(steps)

    def reasoning(self, layout: Layout, index: int) -> Reasoning:
        y_m = [cube.y_m for cube in layout.cubes]
        name = captions.letter(layout.asked, y_m)
        nth, is_putting = divmod(index, 2)
        shown = f"Demo selected the {layout.cubes[layout.asked].color} cube {name}; "
        after = f"after {shuffle.in_words(layout.swaps, y_m)}, "
        if nth == layout.repeats:
            then, ground = f"choose the button[ at <>]: {name} was picked up {nth} of {nth} times.", f"{_BUTTON}/cap"
        else:
            verb = "put it down" if is_putting else "pick it up"
            then, ground = f"choose {name}[ at <>]: {verb}, time {nth + 1} of {layout.repeats}.", _CUBES[layout.asked]
        return Reasoning(text=shown + after + then, grounds=(ground,))

    def retold(self, layout: Layout) -> tuple[Layout, ...]:
        """Another cube of the same colour was picked up. The same cubes changed places, in whichever order they did."""
        asked = layout.cubes[layout.asked]
        return tuple(
            replace(layout, asked=index)
            for index, cube in enumerate(layout.cubes)
            if index != layout.asked and cube.color == asked.color and _can_be_picked_up(layout.cubes, index)
        )

    def remember(self, memory: Memory | None, physics: Physics, layout: Layout) -> Memory:
        is_picked = predicates.is_picked(physics, _CUBES[layout.asked])
        if memory is None:
            rest = shuffle.watch(None, physics, _names(layout))
            return Memory(rest=rest, picking_steps=0, putting_steps=None, has_picked=is_picked)
        putting_steps = memory.putting_steps
        if memory.has_picked:
            putting_steps = 0 if putting_steps is None else putting_steps + 1
        return Memory(
            rest=shuffle.watch(memory.rest, physics, _names(layout)),
            picking_steps=memory.picking_steps + 1,
            putting_steps=putting_steps,
            has_picked=memory.has_picked or is_picked,
        )


def _draw(rng: np.random.Generator, difficulty: str) -> Layout:
    button = draw_button(rng, center_m=_BUTTON_CENTER_M, reach_m=_BUTTON_REACH_M, half_m=BUTTON_ROOM_HALF_M)
    areas = _clutter(rng) if difficulty == "hard" else _alike(rng)
    cubes: list[PlacedCube] = []
    for color, center_m, half_m in areas:
        taken = [button, *(cube.footprint for cube in cubes)]
        cubes.append(draw_cube(rng, color, center_m=center_m, half_m=half_m, obstacles=taken, gap_m=_GAP_M))
    asked = int(rng.integers(len(cubes)))
    # Cubes that swap come to lie where others lay.
    for index in (asked,) if difficulty == "hard" else range(len(cubes)):
        if not _can_be_picked_up(cubes, index):
            raise SceneFullError(f"cube {index} cannot be picked up among the others. Draw the scene again.")
    return Layout(
        button_xy_m=button.center_m,
        cubes=tuple(cubes),
        asked=asked,
        repeats=int(rng.integers(*_REPEATS, endpoint=True)),
        swaps=() if difficulty == "hard" else _draw_swaps(rng, cubes, asked, _SWAPS[difficulty]),
    )


def _can_be_picked_up(cubes: Sequence[PlacedCube], index: int) -> bool:
    cube = cubes[index]
    return is_in_reach((cube.x_m, cube.y_m)) and has_finger_room(cube, [*cubes[:index], *cubes[index + 1 :]])


Area = tuple[str, tuple[float, float], tuple[float, float]]  # a colour, and the centre and half size of a rectangle


def _clutter(rng: np.random.Generator) -> list[Area]:
    """Rounds of all colours, each in random order, anywhere in one wide rectangle."""
    colors = [str(color) for _ in range(_CUBES_PER_COLOR) for color in rng.permutation(list(CUBE_COLORS))]
    return [(color, _CLUTTER_CENTER_M, _CLUTTER_HALF_M) for color in colors]


def _alike(rng: np.random.Generator) -> list[Area]:
    """Three of one colour, each about its own point."""
    color = str(rng.choice(list(CUBE_COLORS)))
    return [(color, center_m, _JITTER_HALF_M) for center_m in turned_at_random(rng, draw_threesome(rng))]


def _draw_swaps(
    rng: np.random.Generator, cubes: list[PlacedCube], asked: int, num_range: tuple[int, int]
) -> tuple[Swap, ...]:
    """The cube asked for moves first, then the others in random order; each with the one nearest to it by then."""
    others = [i for i in range(len(cubes)) if i != asked]
    movers = [asked, *(int(i) for i in rng.permutation(others))]
    spots = [Spot(x_m=cube.x_m, y_m=cube.y_m, yaw_rad=cube.yaw_rad) for cube in cubes]
    pairs: list[Swap] = []
    for mover in movers[: int(rng.integers(*num_range, endpoint=True))]:
        now = swaps.spots_after(spots, pairs, SWAP_STEPS * len(pairs), LANE_M)
        pairs.append((mover, swaps.nearest(now, mover)))
    return tuple(pairs)


def _names(layout: Layout) -> tuple[str, ...]:
    return _CUBES[: len(layout.cubes)]


def _pick(cube: str) -> Callable[[Motions], Actions]:
    return lambda motions: motions.pick(cube)


def _put_down(release_z_m: float) -> Callable[[Motions], Actions]:
    return lambda motions: motions.put_down(release_z_m)


def _mishap(layout: Layout, steps_since_set: Callable[[Memory], int | None]) -> Callable[[Physics, Memory], str | None]:
    others = [name for i, name in enumerate(_names(layout)) if i != layout.asked]

    def failure(physics: Physics, memory: Memory) -> str | None:
        wrong = predicates.first_picked(physics, others)
        if wrong is not None:
            return f"picked up {wrong}, not the cube of the video"
        if predicates.is_pressed(physics, _BUTTON) and steps_since_set(memory) in EARLY_STEPS:
            return f"pressed the button before all was done ({layout.repeats} times)"
        return None

    return failure


def _once_too_many(layout: Layout) -> Callable[[Physics, Memory], str | None]:
    def failure(physics: Physics, memory: Memory) -> str | None:
        picked = predicates.first_picked(physics, _names(layout))
        return None if picked is None else f"picked up {picked} when all was done ({layout.repeats} times)"

    return failure
