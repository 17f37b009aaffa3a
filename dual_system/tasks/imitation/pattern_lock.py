"""PatternLock: watch the stick draw a pattern over a grid of buttons, then retrace it.

The tip touches a button when it is within 1 cm of its centre seen from above, and lower than 10 cm. The robot begins
with its tip over the pattern's first button. Source: RoboMME's PatternLock at 598e3b4, rules restated.

Not kept: upstream also compares the sequence of touched buttons with the pattern at the end. It is then always equal,
because any other button is an immediate failure.

"Left" is the robot's: towards larger y, and on the right of the front camera's picture. "Forward" is away from it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product

import mujoco
import numpy as np

from dual_system.tasks import predicates
from dual_system.tasks.geometry import pose
from dual_system.tasks.imitation import traces
from dual_system.tasks.imitation.traces import TARGET_Z_M, Touches
from dual_system.tasks.oracle import Actions, Motions
from dual_system.tasks.panda import PANDA_STICK
from dual_system.tasks.physics import Physics
from dual_system.tasks.task import Reasoning, Shown, Subtask, Task, task

_SIDE = {"easy": 3, "medium": 4, "hard": 5}  # buttons
_LENGTH = {"easy": (2, 4), "medium": (3, 5), "hard": (4, 8)}  # buttons of a pattern, both ends included
_CENTER_M, _SPACING_M = (-0.1, 0.0), 0.1
_TOUCH_M, _TOUCH_Z_M = 0.01, 0.1
_BUTTONS = tuple(f"target_{i}" for i in range(max(_SIDE.values()) ** 2))


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One grid and one pattern.

    Buttons are counted from the one nearest to the robot on its right, to its left, then row by row away from it.
    """

    side: int  # buttons per row and per column
    pattern: tuple[int, ...]  # buttons in order, each a neighbour of the previous one and none twice

    def xy_m(self, button: int) -> tuple[float, float]:
        """Where a button is on the table."""
        row, column = divmod(button, self.side)
        middle = (self.side - 1) / 2
        return _CENTER_M[0] + _SPACING_M * (row - middle), _CENTER_M[1] + _SPACING_M * (column - middle)

    def directions(self) -> tuple[str, ...]:
        """The way from each button of the pattern to the next, in words."""
        return tuple(self._direction(*pair) for pair in pairwise(self.pattern))

    def _direction(self, start: int, end: int) -> str:
        forward, left = np.subtract(divmod(end, self.side), divmod(start, self.side)).tolist()
        words = (("", "forward", "backward")[forward], ("", "left", "right")[left])
        return "-".join(word for word in words if word)


@task(family="imitation")
class PatternLock(Task[Layout, Touches]):
    """Retrace with the stick a pattern that was shown.

    The memory is when each button of the pattern was last touched, in the order of the pattern.
    """

    robot = PANDA_STICK
    retells_video = True

    def furnish(self, spec: mujoco.MjSpec) -> None:
        traces.add_traces(spec, _BUTTONS)

    def sample(self, rng: np.random.Generator, difficulty: str) -> Layout:
        side, (shortest, longest) = _SIDE[difficulty], _LENGTH[difficulty]
        while True:
            start, end = rng.permutation(side**2)[:2].tolist()
            pattern = _wander(rng, side, start, end)
            if shortest <= len(pattern) <= longest:
                return Layout(side=side, pattern=pattern)

    def arrange(self, physics: Physics, layout: Layout) -> None:
        for index, button in enumerate(_BUTTONS[: layout.side**2]):
            physics.place(button, pose(*layout.xy_m(index), TARGET_Z_M))

    def stage(self, physics: Physics, layout: Layout, memory: Touches | None, step: int) -> None:
        if memory is not None:
            traces.show_touches(physics, _named(layout), memory)
        traces.leave_dot(physics, step)
        physics.refresh()

    def instruction(self, layout: Layout) -> str:
        return "watch the video carefully, then use the stick attached to the robot to retrace the same pattern"

    def subtasks(self, layout: Layout) -> tuple[Subtask, ...]:
        return tuple(
            Subtask(
                text=f"move {direction}",
                is_done=partial(_has_come_to, end),
                failure=partial(_wrong_touch, layout, (start, end)),
                motion=_point_at(end),
            )
            for direction, (start, end) in zip(layout.directions(), pairwise(layout.pattern), strict=True)
        )

    def demonstration(self, layout: Layout) -> tuple[Shown, ...]:
        first, *others = layout.pattern
        return (
            Shown(text="NO RECORD", motion=_point_at(first), is_recorded=False),
            *(
                Shown(text=f"move {direction}", motion=_point_at(button))
                for direction, button in zip(layout.directions(), others, strict=True)
            ),
            Shown(text="NO RECORD", motion=lambda motions: motions.go_home(), is_recorded=False),
            Shown(text="NO RECORD", motion=lambda motions: motions.point_at_once(_BUTTONS[first]), is_recorded=False),
        )

    def reasoning(self, layout: Layout, index: int) -> Reasoning | None:
        places = " -> ".join(f"target_{nth}[ at <>]" for nth in range(len(layout.pattern)))
        directions = layout.directions()
        return Reasoning(
            text=(
                f"Demo sequence: {places}; modes: {', '.join(directions)}. Reproduce exactly; "
                f"next is target_{index} -> target_{index + 1}, {directions[index]}."
            ),
            grounds=_named(layout),
        )

    def retold(self, layout: Layout) -> tuple[Layout, ...]:
        """The pattern began alike, and from one of its buttons on the rest was turned, mirrored or both."""
        return tuple(
            replace(layout, pattern=other)
            for shared in range(1, len(layout.pattern))
            for other in _turned_away(layout.side, layout.pattern, shared)
        )

    def remember(self, memory: Touches | None, physics: Physics, layout: Layout) -> Touches:
        return traces.followed(memory, [_is_touched(physics, button) for button in layout.pattern])

    def first_choice(self, physics: Physics, memory: Touches, layout: Layout, index: int) -> bool | None:
        """The first button that is touched after the pattern's first one is its second."""
        start, right = layout.pattern[:2]
        others = [button for button in range(layout.side**2) if button != start and _is_touched(physics, button)]
        return others == [right] if others else None


def _wander(rng: np.random.Generator, side: int, start: int, end: int) -> tuple[int, ...]:
    """A random way to a button: depth first, neighbours in random order, no button tried twice."""
    way, seen = [start], {start}
    while way[-1] != end:
        fresh = [button for button in neighbours(side, way[-1]) if button not in seen]
        if fresh:
            way.append(int(rng.choice(fresh)))
            seen.add(way[-1])
        else:
            way.pop()
    return tuple(way)


def _turned_away(side: int, pattern: tuple[int, ...], shared: int) -> list[tuple[int, ...]]:
    """The patterns that diverge from this one after ``shared`` buttons, with the same rest in other poses."""
    kept, rest = pattern[:shared], np.array([divmod(button, side) for button in pattern[shared - 1 :]])
    found = []
    for flips, is_transposed in product(product((1, -1), (1, -1)), (False, True)):
        moves = (rest - rest[0]) * flips
        places = rest[0] + (moves[:, ::-1] if is_transposed else moves)
        way = tuple(int(row * side + column) for row, column in places[1:])
        has_room = bool(np.all((places >= 0) & (places < side))) and not set(way) & set(kept)
        if has_room and way[0] != pattern[shared] and (*kept, *way) not in found:
            found.append((*kept, *way))
    return found


def neighbours(side: int, button: int) -> list[int]:
    """Returns the buttons next to one, diagonally too, in ascending order."""
    row, column = divmod(button, side)
    rows, columns = (range(max(at - 1, 0), min(at + 2, side)) for at in (row, column))
    return [r * side + c for r in rows for c in columns if (r, c) != (row, column)]


def _named(layout: Layout) -> tuple[str, ...]:
    return tuple(_BUTTONS[button] for button in layout.pattern)


def _point_at(button: int) -> Callable[[Motions], Actions]:
    return lambda motions: motions.point_at(_BUTTONS[button])


def _is_touched(physics: Physics, button: int) -> bool:
    return predicates.is_tool_over(physics, _BUTTONS[button], within_m=_TOUCH_M, below_z_m=_TOUCH_Z_M)


def _has_come_to(button: int, physics: Physics, memory: Touches) -> bool:
    return _is_touched(physics, button)


def _wrong_touch(layout: Layout, allowed: tuple[int, int], physics: Physics, memory: Touches) -> str | None:
    for button in range(layout.side**2):
        if button not in allowed and _is_touched(physics, button):
            return f"touched {_BUTTONS[button]} on the way from {_BUTTONS[allowed[0]]} to {_BUTTONS[allowed[1]]}"
    return None
