"""Success rate of perfect motion without memory: the ceiling to expect without cognition.

PickHighlight: k of n cubes are lit, and afterwards all look alike. A policy that presses the button first, as
instructed, and then guesses must pick a target each time, since the first wrong cube ends the episode: k/n, then
(k-1)/(n-1), and so on, together 1 / C(n, k), for any order and any way of guessing. Over the benchmark's mix, a third
of each difficulty, that is (1/3 + 1/6 + 1/20) / 3 = 11/60 = 18.3 %.

The ceiling holds for policies that follow the instruction: like its original, the task does not fail wrong picks
before the button is pressed.
"""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from math import comb
from types import MappingProxyType

NUM_CUBES_AND_TARGETS = MappingProxyType({"easy": (3, 1), "medium": (4, 2), "hard": (6, 3)})
"""PickHighlight's number of cubes and of targets, by difficulty."""


def pick_highlight_ceiling(difficulties: Iterable[str]) -> Fraction:
    """Returns the exact expected success without memory over episodes of these difficulties.

    Raises:
        ValueError: there are no episodes.
        KeyError: an unknown difficulty.
    """
    chances = [Fraction(1, comb(*NUM_CUBES_AND_TARGETS[difficulty])) for difficulty in difficulties]
    if not chances:
        raise ValueError("no episodes, no ceiling")
    return sum(chances, Fraction(0)) / len(chances)


def ceiling_of(task: str, difficulties: Iterable[str]) -> Fraction | None:
    """Returns the ceiling of a task over episodes of these difficulties; None if none is known."""
    return pick_highlight_ceiling(difficulties) if task == "PickHighlight" else None
