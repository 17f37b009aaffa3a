"""Ceilings without memory: the best success rate of perfect motion that sees the present and remembers nothing.

The player reads the instruction, sees the scene and where its hand is, and plays the tasks' own motions, each to its
end, in any order and at any odds. It knows no earlier moment: no cue, no count, nothing that it did itself
(`dual_system.analysis.memoryless` is such a player). Four things that it does not do would lift its ceiling:

- It leaves no marks. A cube that is put down elsewhere in every round counts the rounds: a memory on the table.
- It does not peek. A container counts as lifted from 15 cm on, and shows what it hides before.
- It knows nothing of how scenes are drawn. The containers that hide cubes are drawn first, so they stand nearer to the
  middle: of five, the one in the middle is the right one in 24.6 % of scenes (n = 4000), not in 20.
- It cannot tell 1.3 mm: a container over a cube stands so much higher, a seventh of a pixel of the front camera.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from math import comb, perm
from types import MappingProxyType
from typing import Any

LAST_DISC_STEP = 100
"""PickHighlight's last observation that shows the discs."""
_CUBES_AND_TARGETS = MappingProxyType({"easy": (3, 1), "medium": (4, 2), "hard": (6, 3)})


def unmask(num_containers: int, num_picks: int) -> Fraction:
    """VideoUnmask: which containers hide the cubes that are asked for, in their order.

    Nothing tells covered containers apart, so all ordered choices of ``num_picks`` of them are alike, one of them is
    right, and the first wrong lift ends the episode. The hand over a container that was put down tells that this one
    was taken.
    """
    return Fraction(1, perm(num_containers, num_picks))


def highlight(num_cubes: int, num_targets: int, *, saw_one: bool = False) -> Fraction:
    """PickHighlight, with the button pressed first as instructed: which cubes were lit.

    From the press on the first wrong cube ends the episode, and right ones tell nothing of the others. So the first k
    different cubes that are picked must be the k targets of n: one of C(n, k) sets, for any order and any odds. A
    player that forgets what it picked reaches that: the place of its hand tells it the next cube, round the table.
    With ``saw_one`` the discs still lay there when it chose the first cube, which then is right, and the others are a
    set of k - 1 of the n - 1 that are left.

    A player that never presses always succeeds, here as upstream: no pick is wrong before the press.
    """
    return Fraction(1, comb(num_cubes - saw_one, num_targets - saw_one))


def highlight_in(difficulty: str, *, saw_one: bool = False) -> Fraction:
    """Returns `highlight` of a difficulty's scenes, which are all of one size. Raises KeyError for an unknown one."""
    return highlight(*_CUBES_AND_TARGETS[difficulty], saw_one=saw_one)


def same_manner() -> Fraction:
    """MoveCube: how the video's cube was moved, by one of three manners at equal odds.

    What comes first decides: the peg in the hand, the cube in the hand, or the cube on the target. Each of them is the
    first of one manner and fails the two others, and the scene is drawn anew after the video, so it tells no manner.
    """
    return Fraction(1, 3)


def rounds(num_rounds: int) -> Fraction:
    """PickXtimes and SwingXtimes: stop after exactly ``num_rounds`` rounds, as the instruction says.

    Before the first round the cube lies elsewhere, so the first round is always begun. All rounds end alike, so the
    player stops with the same probability p after each, which may depend on n. It stops after exactly n of them with
    probability (1 - p)^(n - 1) p, which is largest for p = 1/n. To draw p anew each time gains nothing: the rate then
    depends on its mean alone.
    """
    return Fraction(num_rounds - 1, num_rounds) ** (num_rounds - 1) / num_rounds


PATTERN_LOCK = MappingProxyType({3: Fraction(121, 1000), 4: Fraction(39, 1000), 5: Fraction(9, 1000)})
"""PatternLock, by buttons in a row: where a pattern goes from its first button, estimated and no exact figure.

The stick walks from button to button, the first wrong one ends the episode, and success comes with the last right one.
So a walk succeeds in the patterns that it begins with. The best walk from each button of 25,000 drawn patterns of each
size, turned and mirrored, came to 12.1, 3.8 and 0.9 % of 25,000 others, with standard errors of 0.2, 0.1 and 0.06. The
rule in `memoryless` needs no such table and comes to 12.0, 4.0 and 0.6 % of 20,000.
"""

_OF_LAYOUT: Mapping[str, Callable[[Any], Fraction]] = MappingProxyType(
    {
        "VideoUnmask": lambda layout: unmask(len(layout.containers), layout.num_picks),
        "PickHighlight": lambda layout: highlight(len(layout.cubes), len(layout.targets)),
        "MoveCube": lambda layout: same_manner(),
        "PickXtimes": lambda layout: rounds(layout.repeats),
        "SwingXtimes": lambda layout: rounds(layout.repeats),
        "PatternLock": lambda layout: PATTERN_LOCK[layout.side],
    }
)


def ceiling_in(task: str, layout: Any) -> Fraction | None:
    """Returns the ceiling in one scene, whose layout is the task's; None if none is known."""
    return _OF_LAYOUT[task](layout) if task in _OF_LAYOUT else None


_FIRST_STEP = MappingProxyType({3: Fraction(253, 1000), 4: Fraction(215, 1000), 5: Fraction(204, 1000)})
"""PatternLock, by buttons in a row: the second button of a pattern, guessed from the first; estimated as `PATTERN_LOCK`
was, with a standard error of 0.3 %. One of the first button's neighbours is right, and they are nearly alike."""

_FIRST_OF_LAYOUT: Mapping[str, Callable[[Any], Fraction]] = MappingProxyType(
    {
        "VideoUnmask": lambda layout: Fraction(1, len(layout.containers)),
        "PickHighlight": lambda layout: Fraction(len(layout.targets), len(layout.cubes)),
        "MoveCube": lambda layout: same_manner(),
        "PickXtimes": lambda layout: rounds(layout.repeats),  # to stop is the only choice
        "SwingXtimes": lambda layout: rounds(layout.repeats),
        "PatternLock": lambda layout: _FIRST_STEP[layout.side],
    }
)


def first_choice_in(task: str, layout: Any) -> Fraction | None:
    """Returns the best chance without memory that the first choice in one scene is right (`Task.first_choice`).

    It is None if none is known. PickHighlight's holds once the discs are gone.
    """
    return _FIRST_OF_LAYOUT[task](layout) if task in _FIRST_OF_LAYOUT else None


def _mean(values: Iterable[Fraction]) -> Fraction:
    found = list(values)
    return sum(found, Fraction(0)) / len(found)


_OF_DIFFICULTY: Mapping[str, Mapping[str, Fraction]] = MappingProxyType(
    {
        "VideoUnmask": {"easy": unmask(3, 1), "medium": unmask(5, 1), "hard": unmask(9, 2)},
        "PickHighlight": {difficulty: highlight_in(difficulty) for difficulty in _CUBES_AND_TARGETS},
        "MoveCube": dict.fromkeys(("easy", "medium", "hard"), same_manner()),
        "PickXtimes": {
            "easy": _mean(map(rounds, (1, 2, 3))),
            "medium": _mean(map(rounds, (1, 2, 3))),
            "hard": _mean(map(rounds, (4, 5))),
        },
        "SwingXtimes": {
            "easy": _mean(map(rounds, (1, 2, 3))),
            "medium": _mean(map(rounds, (1, 2))),
            "hard": rounds(3),
        },
        "PatternLock": {"easy": PATTERN_LOCK[3], "medium": PATTERN_LOCK[4], "hard": PATTERN_LOCK[5]},
    }
)
"""Over the scenes of a difficulty. VideoUnmask's hard scenes try for fifteen containers, and there is room for six to
twelve, as a rule nine: 1.36 % over 253 drawn scenes, 1.39 % in one of nine."""


def ceiling_of(task: str, difficulty: str) -> Fraction | None:
    """Returns the expected ceiling over the scenes of a difficulty; None if none is known."""
    return _OF_DIFFICULTY.get(task, {}).get(difficulty)
