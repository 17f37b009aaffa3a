"""What perfect motion without memory reaches: the rate at which to expect success when cognition is taken away.

PickHighlight: k of n cubes were lit, and afterwards all look alike. Whoever presses the button first, as told, and then
picks without knowing must hit a target each time, since the first wrong cube ends the episode: k/n, then (k-1)/(n-1),
and so on, in all 1 / C(n, k), whatever the order and however it guesses. Over the benchmark's mix, a third of each
difficulty, that is (1/3 + 1/6 + 1/20) / 3 = 11/60 = 18.3 %.

It is a ceiling of those who follow the instruction: the task, like its original, does not fail wrong picks before the
button was pressed.
"""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from math import comb
from types import MappingProxyType

NUM_CUBES_AND_TARGETS = MappingProxyType({"easy": (3, 1), "medium": (4, 2), "hard": (6, 3)})
"""Of PickHighlight."""


def pick_highlight_ceiling(difficulties: Iterable[str]) -> Fraction:
    """Returns the expected success without memory, exactly, over episodes of these difficulties.

    Raises:
        ValueError: there are none.
        KeyError: an unknown difficulty.
    """
    chances = [Fraction(1, comb(*NUM_CUBES_AND_TARGETS[difficulty])) for difficulty in difficulties]
    if not chances:
        raise ValueError("no episodes, no ceiling")
    return sum(chances, Fraction(0)) / len(chances)


def ceiling_of(task: str, difficulties: Iterable[str]) -> Fraction | None:
    """Returns the ceiling of a task over episodes of these difficulties; None where none is derived."""
    return pick_highlight_ceiling(difficulties) if task == "PickHighlight" else None
