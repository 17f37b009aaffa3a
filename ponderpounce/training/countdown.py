"""How long there is to wait: what a stand-in tells a hand that is to act on the second.

Where something is to be done at one instant (StopCube), a subgoal that begins when it is due comes too late. A
cognition is looked at for up to 2.3 s after its picture was taken, and the hand knows its age: so it has to tell how
long there was still to wait then. Told in control steps, as the second coordinate of a place.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from ponderpounce.models.place_code import PLACE_PX

_WAITING = re.compile(r"^remain static$| to prepare$")
_LONGEST = PLACE_PX - 1


def waits(subgoals: Sequence[str]) -> list[int | None]:
    """Per tick of an episode, how many there are until it no longer waits; None where it does not, or never ends."""
    found: list[int | None] = []
    left: int | None = None
    for text in reversed(subgoals):
        if not _WAITING.search(text):
            left = 0
            found.append(None)
            continue
        left = None if left is None else left + 1
        found.append(left)
    return found[::-1]


def as_place(wait: int) -> str:
    """The wait as a place."""
    return f"<0, {min(wait, _LONGEST)}>"
