"""Base of VideoPlaceButton and VideoPlaceOrder: a video of placing, and one of its places to be found again.

In the video a cube is carried from target to target, the button is pressed at some point between, and at last the cube
is put aside on the bare table. Where the scene is hard, two targets then change places. Source: RoboMME's VideoPlace*
at 598e3b4, rules restated.

Upstream keeps a scene if its planner solves it. Ours are drawn so that other cubes leave room where the cube is put
aside; upstream's ignore that place.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from dual_system.tasks import captions, predicates
from dual_system.tasks.geometry import distance_m, pose
from dual_system.tasks.oracle import Actions, Motions
from dual_system.tasks.physics import Physics
from dual_system.tasks.placing import (
    BUTTON_ROOM_HALF_M,
    Disc,
    PlacedCube,
    Point,
    draw_button,
    draw_cube,
    draw_disc,
    has_finger_room,
    is_in_reach,
)
from dual_system.tasks.props import PURPLE, TARGET_RADIUS_M, TARGET_THICKNESS_M, add_target
from dual_system.tasks.reference import shuffle
from dual_system.tasks.reference.shuffle import Rest
from dual_system.tasks.scene import CUBE_COLORS, SceneFullError, add_button, add_cube
from dual_system.tasks.swaps import Swap
from dual_system.tasks.task import Reasoning, Shown, Subtask, Task

LANE_M = 0.1

_NUM_CUBES = {"easy": 1, "medium": 3, "hard": 3}
_MAX_TARGETS = 4
_HOLD_STEPS = 60  # the video ends with; time for one swap
_CENTER_M, _HALF_M = (0.0, 0.0), (0.2, 0.2)
_GAP_M = 0.02
_BUTTON_CENTER_M, _BUTTON_REACH_M = (0.1, 0.0), (0.025, 0.15)
_PARKING_CENTER_M, _PARKING_HALF_M = (-0.1, 0.0), (0.1, 0.1)
_PARKING_ROOM_M = 0.05
_ASIDE_RELEASE_Z_M = 0.01
_BUTTON = "button"
_CUBES = tuple(f"cube_{i}" for i in range(max(_NUM_CUBES.values())))
_TARGETS = tuple(f"target_{i}" for i in range(_MAX_TARGETS))


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One scene: initial places, the video's actions, and the place to be found."""

    button_xy_m: Point
    parking_xy_m: Point  # where the cube is put aside
    cubes: tuple[PlacedCube, ...]  # each of another color
    targets_xy_m: tuple[Point, ...]
    carried: int  # index of the cube
    visits: tuple[int, ...]  # indices of the targets it is placed on, in order
    num_before_press: int  # visits before the button is pressed; at least one
    asked: int  # index into visits
    swaps: tuple[Swap, ...] = ()  # pairs of targets; at most one

    @property
    def answer(self) -> int:
        """Index of the target on which the cube must be placed."""
        return self.visits[self.asked]

    @property
    def color(self) -> str:
        """The color of the cube that is carried."""
        return self.cubes[self.carried].color


class VideoPlace(Task[Layout, Rest | None]):
    """Place a cube on the target that a video identifies by its place in the sequence of events.

    The memory is the arm's rest in the demonstration; there is none after it.
    """

    retells_video = True

    def furnish(self, spec: mujoco.MjSpec) -> None:
        add_button(spec, _BUTTON)
        for target in _TARGETS:
            add_target(spec, target, PURPLE)
        for cube in _CUBES:
            add_cube(spec, cube)

    def arrange(self, physics: Physics, layout: Layout) -> None:
        physics.place(_BUTTON, pose(*layout.button_xy_m, 0.0))
        for target, xy_m in zip(_TARGETS, layout.targets_xy_m, strict=False):
            physics.place(target, pose(*xy_m, TARGET_THICKNESS_M))
        for name, cube in zip(_CUBES, layout.cubes, strict=False):
            cube.put(physics, name)

    def stage(self, physics: Physics, layout: Layout, memory: Rest | None, step: int) -> None:
        names = _targets(layout)
        shuffle.move(physics, memory, names, layout.swaps, step=step, lane_m=LANE_M, z_m=TARGET_THICKNESS_M)

    @abstractmethod
    def which(self, layout: Layout) -> str:
        """Returns the words that identify the target."""

    def instruction(self, layout: Layout) -> str:
        return f"watch the video carefully, then place the {layout.color} cube on the {self.which(layout)}"

    def demonstration(self, layout: Layout) -> tuple[Shown, ...]:
        cube = _CUBES[layout.carried]
        pick = Shown(text="pick up the cube[ at <>]", grounds=(cube,), motion=lambda motions: motions.pick(cube))
        parts = []
        for nth, visited in enumerate(layout.visits, start=1):
            target = _TARGETS[visited]
            parts += [pick, Shown(text="drop the cube onto target[ at <>]", grounds=(target,), motion=_place(target))]
            if nth == layout.num_before_press:
                cap = f"{_BUTTON}/cap"
                parts.append(Shown(text="press the button[ at <>]", grounds=(cap,), motion=_press))
        return (
            *parts,
            pick,
            Shown(
                text="drop the cube onto table",
                motion=lambda motions: motions.place_at(*layout.parking_xy_m, _ASIDE_RELEASE_Z_M),
            ),
            Shown(text="static", motion=shuffle.rest),
            Shown(text="static", motion=lambda motions: motions.wait(_HOLD_STEPS)),
            Shown(text="NO RECORD", motion=lambda motions: motions.go_home(), is_recorded=False),
        )

    def subtasks(self, layout: Layout) -> tuple[Subtask, ...]:
        cube, target = _CUBES[layout.carried], _TARGETS[layout.answer]
        return (
            Subtask(
                text="pick up the cube[ at <>]",
                grounds=(cube,),
                is_done=lambda physics, memory: predicates.is_picked(physics, cube),
                failure=_wrong_cube(layout),
                motion=lambda motions: motions.pick(cube),
            ),
            Subtask(
                text="place the cube onto the correct target[ at <>]",
                grounds=(target,),
                is_done=lambda physics, memory: predicates.is_dropped_onto(physics, cube, target),
                failure=_wrong_target(layout),
                motion=_place(target),
                carries=(cube,),
            ),
        )

    def reasoning(self, layout: Layout, index: int) -> Reasoning:
        y_m = [y for _, y in layout.targets_xy_m]
        course = [captions.letter(visited, y_m) for visited in layout.visits]
        course.insert(layout.num_before_press, "button")
        name, cube, target = captions.letter(layout.answer, y_m), _CUBES[layout.carried], _TARGETS[layout.answer]
        text = (
            f"Demo selected the order {', '.join(course)} for the {layout.color} cube; "
            f"after tracking {name}, the {self.which(layout)}, through {shuffle.in_words(layout.swaps, y_m)}, choose "
        )
        if index == 0:
            text += f"the {layout.color} cube[ at <>] for target {name}[ at <>]."
            return Reasoning(text=text, grounds=(cube, target))
        return Reasoning(text=text + f"target {name}[ at <>].", grounds=(target,))

    def retold(self, layout: Layout) -> tuple[Layout, ...]:
        """The cube was placed on the same targets, beginning with another one of them."""
        visits = layout.visits
        return tuple(replace(layout, visits=visits[nth:] + visits[:nth]) for nth in range(1, len(visits)))

    def remember(self, memory: Rest | None, physics: Physics, layout: Layout) -> Rest | None:
        return shuffle.watch(memory, physics, _targets(layout))


def draw_scene(
    rng: np.random.Generator, difficulty: str, *, num_targets: int, parking_radius_m: float
) -> tuple[Point, Point, tuple[PlacedCube, ...], tuple[Point, ...]]:
    """Draws where the cube is put aside, the button, the cubes and the targets; the first cube is the one carried."""
    parking_xy_m = draw_disc(
        rng,
        radius_m=parking_radius_m,
        center_m=_PARKING_CENTER_M,
        half_m=_PARKING_HALF_M,
        obstacles=(),
        gap_m=0.0,
    )
    button = draw_button(rng, center_m=_BUTTON_CENTER_M, reach_m=_BUTTON_REACH_M, half_m=BUTTON_ROOM_HALF_M)
    cubes: list[PlacedCube] = []
    for color in rng.permutation(list(CUBE_COLORS))[: _NUM_CUBES[difficulty]].tolist():
        taken = [button, *(cube.footprint for cube in cubes)]
        cubes.append(draw_cube(rng, color, center_m=_CENTER_M, half_m=_HALF_M, obstacles=taken, gap_m=_GAP_M))
    carried, *others = cubes
    if not (is_in_reach((carried.x_m, carried.y_m)) and has_finger_room(carried, others)):
        raise SceneFullError("the cube cannot be picked up among the others. Draw the scene again.")
    if any(distance_m(parking_xy_m, cube.footprint) < _PARKING_ROOM_M for cube in others):
        raise SceneFullError(f"a cube lies within {_PARKING_ROOM_M} m of {parking_xy_m}. Draw the scene again.")
    discs: list[Disc] = [(parking_xy_m, parking_radius_m)]
    for _ in range(num_targets):
        target_xy_m = draw_disc(
            rng,
            radius_m=TARGET_RADIUS_M,
            center_m=_CENTER_M,
            half_m=_HALF_M,
            obstacles=[button, *(cube.footprint for cube in cubes)],
            discs=discs,
            gap_m=_GAP_M,
        )
        discs.append((target_xy_m, TARGET_RADIUS_M))
    return button.center_m, parking_xy_m, tuple(cubes), tuple(center_m for center_m, _ in discs[1:])


def draw_swaps(rng: np.random.Generator, difficulty: str, num_targets: int) -> tuple[Swap, ...]:
    """Draws which two targets change places; none do unless the scene is hard."""
    if difficulty != "hard":
        return ()
    first, second = rng.permutation(num_targets)[:2]
    return ((int(first), int(second)),)


def _targets(layout: Layout) -> Sequence[str]:
    return _TARGETS[: len(layout.targets_xy_m)]


def _place(target: str) -> Callable[[Motions], Actions]:
    return lambda motions: motions.place(target)


def _press(motions: Motions) -> Actions:
    yield from motions.press(_BUTTON)


def _wrong_cube(layout: Layout) -> Callable[[Physics, Rest | None], str | None]:
    others = [name for i, name in enumerate(_CUBES[: len(layout.cubes)]) if i != layout.carried]

    def failure(physics: Physics, memory: Rest | None) -> str | None:
        wrong = predicates.first_picked(physics, others)
        if wrong is None:
            return None
        return f"picked up {wrong}, a {layout.cubes[_CUBES.index(wrong)].color} cube, not the {layout.color} one"

    return failure


def _wrong_target(layout: Layout) -> Callable[[Physics, Rest | None], str | None]:
    cube = _CUBES[layout.carried]

    def failure(physics: Physics, memory: Rest | None) -> str | None:
        for index, target in enumerate(_targets(layout)):
            if index != layout.answer and predicates.is_dropped_onto(physics, cube, target):
                return f"placed the cube onto {target}, not onto {_TARGETS[layout.answer]}"
        return None

    return failure
