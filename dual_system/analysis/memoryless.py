"""A scripted player with perfect motion and no memory: what `dual_system.analysis.ceiling` says is played out here.

It plays the motions of the task's own script. Whatever the scene or the instruction shows it takes from the layout;
whatever only the past could tell it draws, at the odds that the ceiling's derivation gives. So its success rate lies
below the ceiling by the grasps that fail, and differs from it by chance otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.imitation.move_cube import MANNERS
from dual_system.tasks.imitation.pattern_lock import neighbours
from dual_system.tasks.kinematics import UnreachableError
from dual_system.tasks.oracle import Motions
from dual_system.tasks.task import Subtask, Task

_LONGEST_PATTERN = 8
_PLAYER_STREAM = 9  # of a seed's random numbers; the scene, noise, shoves and corrections draw from others


@dataclass(frozen=True, slots=True, kw_only=True)
class Play:
    """One episode of the player."""

    is_success: bool
    first_choice: bool | None
    """Whether the first choice was right; None if there was none."""
    began: tuple[int, ...]
    """The steps at which its motions began."""
    layout: Any


def play(environment: Environment, seed: int, difficulty: str | None = None, *, saw_one: bool = False) -> Play:
    """Plays a scene of a task in `PLAYERS` to its end.

    With ``saw_one`` PickHighlight's player saw the discs when it chose the first cube.
    """
    snapshot = environment.reset(seed, difficulty)
    layout, rng = environment.layout, np.random.default_rng((seed, _PLAYER_STREAM))
    if saw_one:
        acts = _highlighted(environment.task, layout, rng, first=layout.targets[0])
    else:
        acts = PLAYERS[environment.task.name](environment.task, layout, rng)
    motions, began = Motions(environment.physics), list[int]()
    for act in acts:
        began.append(snapshot.step)
        try:
            for action in act.motion(motions):
                snapshot = environment.step(action, look=False)
                if snapshot.status is not Status.ONGOING:
                    return _played(snapshot, began, layout)
        except UnreachableError:
            break
    return _played(snapshot, began, layout)


def _played(last: Snapshot, began: list[int], layout: Any) -> Play:
    is_success = last.status is Status.SUCCESS
    return Play(is_success=is_success, first_choice=last.first_choice, began=tuple(began), layout=layout)


def _unmask(task: Task[Any, Any], layout: Any, rng: np.random.Generator) -> Iterable[Subtask]:
    """Lifts any container, puts it down if another is asked for, and lifts any but the one under its hand."""
    lifted = rng.permutation(len(layout.containers))[: layout.num_picks].tolist()
    imagined = [replace(cube, container=at) for cube, at in zip(layout.hidden, lifted, strict=False)]
    return task.subtasks(replace(layout, hidden=(*imagined, *layout.hidden[layout.num_picks :])))


def _highlighted(
    task: Task[Any, Any], layout: Any, rng: np.random.Generator, first: int | None = None
) -> Iterable[Subtask]:
    """Presses the button, picks any cube or the one whose disc it saw, and goes on round the table.

    The table holds two or three blocks of as many neighbours as are asked for. It stays in the first cube's block, so
    that it comes to each cube once, and the place of its hand alone tells it the next.
    """
    num_cubes, num_targets = len(layout.cubes), len(layout.targets)
    round_the_table = sorted(range(num_cubes), key=lambda cube: layout.cubes[cube].y_m)
    first = int(rng.integers(num_cubes)) if first is None else first
    place = round_the_table.index(first)
    begin = place - place % num_targets
    picked = [round_the_table[begin + (place - begin + k) % num_targets] for k in range(num_targets)]
    return task.subtasks(replace(layout, targets=tuple(picked)))


def _in_any_manner(task: Task[Any, Any], layout: Any, rng: np.random.Generator) -> Iterable[Subtask]:
    return task.subtasks(replace(layout, manner=str(rng.choice(list(MANNERS)))))


def _along_the_edge(task: Task[Any, Any], layout: Any, rng: np.random.Generator) -> Iterable[Subtask]:
    """Goes to the button with the fewest neighbours next to the stick, but to neither that is still red: the last two.

    A pattern goes to each of a button's fresh neighbours at equal odds, so where there are few it is guessed best.
    """
    walk = [layout.pattern[0]]
    while len(walk) < _LONGEST_PATTERN:
        fresh = [button for button in neighbours(layout.side, walk[-1]) if button not in walk[-3:]]
        fewest = min(len(neighbours(layout.side, button)) for button in fresh)
        walk.append(int(rng.choice([b for b in fresh if len(neighbours(layout.side, b)) == fewest])))
    return task.subtasks(replace(layout, pattern=tuple(walk)))


def _until_it_stops(before: int, each: int) -> Callable[[Task[Any, Any], Any, np.random.Generator], Iterator[Subtask]]:
    """A player that stops after every round at odds of one in n.

    Args:
        before: number of motions before the first round.
        each: number of motions of a round.
    """

    def player(task: Task[Any, Any], layout: Any, rng: np.random.Generator) -> Iterator[Subtask]:
        script = task.subtasks(replace(layout, repeats=1))
        yield from script[:before]
        stops = False
        while not stops:
            yield from script[before : before + each]
            stops = rng.random() < 1 / layout.repeats
        yield from script[before + each :]

    return player


PLAYERS: Mapping[str, Callable[[Task[Any, Any], Any, np.random.Generator], Iterable[Subtask]]] = MappingProxyType(
    {
        "VideoUnmask": _unmask,
        "PickHighlight": _highlighted,
        "MoveCube": _in_any_manner,
        "PickXtimes": _until_it_stops(0, 2),
        "SwingXtimes": _until_it_stops(1, 2),
        "PatternLock": _along_the_edge,
    }
)
"""What the player of each task does, motion by motion."""
