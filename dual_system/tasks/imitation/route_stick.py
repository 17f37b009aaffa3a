"""RouteStick: watch the stick's way around a row of posts, then follow the same way, on the same side of every post.

Five targets and four posts stand in a row by turns. A move goes from a target to a neighbour and around the post
between them; clockwise is on the left of the line between the targets, seen in the direction of the move. It is
judged when the tip arrives, by the mean of where it has been since it arrived before. Source: RoboMME's RouteStick at
598e3b4, rules restated.

Not kept: upstream counts the places under the posts among the targets that must not be touched. No tip gets there.

"Left" in the texts is the robot's: towards larger y, and on the right of the front camera's picture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import mujoco
import numpy as np

from dual_system.tasks import predicates
from dual_system.tasks.geometry import pose
from dual_system.tasks.imitation import traces
from dual_system.tasks.imitation.traces import TARGET_Z_M, Touches
from dual_system.tasks.oracle import Actions, Motions
from dual_system.tasks.panda import PANDA_STICK
from dual_system.tasks.physics import Physics
from dual_system.tasks.props import add_block
from dual_system.tasks.scene import display_rgba
from dual_system.tasks.task import Reasoning, Shown, Subtask, Task, task

CLOCKWISE, COUNTERCLOCKWISE = "clockwise", "counterclockwise"
_OPPOSITE = {CLOCKWISE: COUNTERCLOCKWISE, COUNTERCLOCKWISE: CLOCKWISE}

_NUM_MOVES = {"easy": (2, 3), "medium": (4, 5), "hard": (4, 7)}  # both ends included
_MAY_TURN_BACK = {"easy": False, "medium": False, "hard": True}  # elsewhere only at an end of the row
_NUM_SLOTS, _SPACING_M, _ROW_X_M, _MAX_TURN_RAD = 9, 0.07, -0.1, np.pi / 6
_POST_HALF_M = (0.03, 0.015, 0.05)
_BULGE_M = 0.2
_HOMING_STEPS = 200
_ARRIVAL_M, _ARRIVAL_Z_M = 0.03, 0.15
_RED_Z_M = 0.1
_TOUCH_M, _TOUCH_Z_M = 0.01, 0.1
_TARGETS = tuple(f"target_{slot}" for slot in range(0, _NUM_SLOTS, 2))
_POSTS = tuple(f"post_{slot}" for slot in range(1, _NUM_SLOTS, 2))

RGB = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One row and one way along it. Targets are counted from the robot's right."""

    turn_rad: float  # of the whole row about the world's origin
    post_colors: tuple[RGB, ...]  # linear, as upstream states them
    route: tuple[int, ...]  # targets in order, each a neighbour of the previous one
    sides: tuple[str, ...]  # of each move

    def xy_m(self, slot: int) -> tuple[float, float]:
        """Where a slot of the row is on the table: target i has slot 2 i, a post the slot between two targets."""
        y_m = _SPACING_M * (slot - (_NUM_SLOTS - 1) / 2)
        c, s = float(np.cos(self.turn_rad)), float(np.sin(self.turn_rad))
        return c * _ROW_X_M - s * y_m, s * _ROW_X_M + c * y_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """The move that is being made, and where the tip has been in it."""

    move: int
    has_arrived: bool
    num_points: int
    sum_xy_m: tuple[float, float]  # of so many points
    touches: Touches  # by target

    def leaning_m2(self, layout: Layout) -> float:
        """Twice the area between the move's line and the mean point: positive on its left, that is clockwise."""
        (start_x, start_y), (end_x, end_y) = (layout.xy_m(2 * at) for at in layout.route[self.move : self.move + 2])
        x, y = np.divide(self.sum_xy_m, self.num_points).tolist()
        return float((end_x - start_x) * (y - start_y) - (end_y - start_y) * (x - start_x))


@task(family="imitation")
class RouteStick(Task[Layout, Memory]):
    """Follow with the stick a way between posts that was shown."""

    robot = PANDA_STICK
    retells_video = True

    def furnish(self, spec: mujoco.MjSpec) -> None:
        traces.add_traces(spec, _TARGETS)
        for post in _POSTS:
            add_block(spec, post, _POST_HALF_M)

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        turn_rad = float(rng.uniform(-_MAX_TURN_RAD, _MAX_TURN_RAD))
        colors = rng.uniform(size=(len(_POSTS), 3)).tolist()
        num_moves = int(rng.integers(*_NUM_MOVES[difficulty], endpoint=True))
        return Layout(
            turn_rad=turn_rad,
            post_colors=tuple((r, g, b) for r, g, b in colors),
            route=_walk(rng, num_moves, may_turn_back=_MAY_TURN_BACK[difficulty]),
            sides=tuple(str(side) for side in rng.choice([CLOCKWISE, COUNTERCLOCKWISE], num_moves)),
        )

    def arrange(self, physics: Physics, layout: Layout) -> None:
        for index, target in enumerate(_TARGETS):
            physics.place(target, pose(*layout.xy_m(2 * index), TARGET_Z_M))
        for index, (post, color) in enumerate(zip(_POSTS, layout.post_colors, strict=True)):
            physics.place(post, pose(*layout.xy_m(2 * index + 1), _POST_HALF_M[2], layout.turn_rad))
            physics.paint(post, display_rgba((*color, 1.0)))

    def stage(self, physics: Physics, layout: Layout, memory: Memory | None, step: int) -> None:
        if memory is not None:
            traces.show_touches(physics, _TARGETS, memory.touches)
        traces.leave_dot(physics, step)
        physics.refresh()

    def instruction(self, layout: Layout) -> str:
        return (
            "watch the video carefully, then use the stick attached to the robot to navigate around the sticks on the "
            "table, following the same path"
        )

    def subtasks(self, layout: Layout) -> tuple[Subtask, ...]:
        return tuple(
            Subtask(
                text=_text(start, end, side),
                is_done=lambda physics, memory: memory.has_arrived,
                failure=partial(_mishap, layout, move),
                motion=_sweep(end, side),
            )
            for move, (start, end, side) in enumerate(_moves(layout))
        )

    def demonstration(self, layout: Layout) -> tuple[Shown, ...]:
        first = _TARGETS[layout.route[0]]
        return (
            Shown(text="NO RECORD", motion=lambda motions: motions.point_at(first), is_recorded=False),
            *(Shown(text=_text(start, end, side), motion=_sweep(end, side)) for start, end, side in _moves(layout)),
            Shown(text="NO RECORD", motion=lambda motions: motions.go_home(_HOMING_STEPS), is_recorded=False),
            Shown(text="NO RECORD", motion=lambda motions: motions.point_at_once(first), is_recorded=False),
        )

    def reasoning(self, layout: Layout, index: int) -> Reasoning | None:
        places = " -> ".join(f"target_{nth}[ at <>]" for nth in range(len(layout.route)))
        start, end, side = _moves(layout)[index]
        return Reasoning(
            text=(
                f"Demo sequence: {places}; modes: {', '.join(layout.sides)}. Reproduce exactly; next is "
                f"target_{index} -> target_{index + 1}, on the {_hand(start, end)}, circling {side} around the post "
                "between."
            ),
            grounds=tuple(_TARGETS[at] for at in layout.route),
        )

    def retold(self, layout: Layout) -> tuple[Layout, ...]:
        """One of the posts was passed on the other side."""
        return tuple(
            replace(layout, sides=(*layout.sides[:move], _OPPOSITE[side], *layout.sides[move + 1 :]))
            for move, side in enumerate(layout.sides)
        )

    def remember(self, memory: Memory | None, physics: Physics, layout: Layout) -> Memory:
        x_m, y_m, _ = physics.tcp_transform()[:3, 3].tolist()
        move, num_points, (sum_x_m, sum_y_m) = 0, 0, (0.0, 0.0)
        if memory is not None and memory.has_arrived:
            move = memory.move + 1
        elif memory is not None:
            move, num_points, (sum_x_m, sum_y_m) = memory.move, memory.num_points, memory.sum_xy_m
        end = layout.route[min(move + 1, len(layout.route) - 1)]
        return Memory(
            move=move,
            has_arrived=_is_over(physics, end, _ARRIVAL_M, _ARRIVAL_Z_M),
            num_points=num_points + 1,
            sum_xy_m=(sum_x_m + x_m, sum_y_m + y_m),
            touches=traces.followed(
                memory.touches if memory else None,
                [_is_over(physics, at, _ARRIVAL_M, _RED_Z_M) for at in range(len(_TARGETS))],
            ),
        )


def _walk(rng: np.random.Generator, num_moves: int, *, may_turn_back: bool) -> tuple[int, ...]:
    """A random walk from target to neighbouring target. At an end of the row, it always turns back."""
    route = [int(rng.integers(len(_TARGETS)))]
    for _ in range(num_moves):
        here = route[-1]
        neighbours = [at for at in (here - 1, here + 1) if 0 <= at < len(_TARGETS)]
        onward = [at for at in neighbours if at not in route[-2:-1]]
        route.append(int(rng.choice(neighbours if may_turn_back or not onward else onward)))
    return tuple(route)


def _moves(layout: Layout) -> list[tuple[int, int, str]]:
    """Start, end and side of every move."""
    return [(start, end, side) for (start, end), side in zip(pairwise(layout.route), layout.sides, strict=True)]


def _hand(start: int, end: int) -> str:
    return "left" if end > start else "right"


def _text(start: int, end: int, side: str) -> str:
    return f"move to the nearest {_hand(start, end)} target by circling around the stick {side}"


def _sweep(target: int, side: str) -> Callable[[Motions], Actions]:
    bulge_m = _BULGE_M if side == CLOCKWISE else -_BULGE_M
    return lambda motions: motions.sweep_to(_TARGETS[target], bulge_m)


def _is_over(physics: Physics, target: int, within_m: float, below_z_m: float) -> bool:
    return predicates.is_tool_over(physics, _TARGETS[target], within_m=within_m, below_z_m=below_z_m)


def _mishap(layout: Layout, move: int, physics: Physics, memory: Memory) -> str | None:
    start, end, side = _moves(layout)[move]
    for target in range(len(_TARGETS)):
        if target not in (start, end) and _is_over(physics, target, _TOUCH_M, _TOUCH_Z_M):
            return f"touched {_TARGETS[target]} on the way from {_TARGETS[start]} to {_TARGETS[end]}"
    outward = 1.0 if side == CLOCKWISE else -1.0
    if memory.has_arrived and outward * memory.leaning_m2(layout) <= 0:
        return f"came from {_TARGETS[start]} to {_TARGETS[end]} on the wrong side of the post; {side} was shown"
    return None
