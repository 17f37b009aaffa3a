"""How long there is to wait: what a stand-in tells a hand that is to act on the second.

Where something is to be done at one instant (StopCube), a subgoal that begins when it is due comes too late. A
cognition is looked at for up to 2.3 s after its picture was taken, and the hand knows its age: so it has to tell how
long there was still to wait then. Told in control steps, as the second coordinate of a place.

PONDER says the number, too, once a second: the next one is the last one less 20, which is learned sooner than what is
to be waited for.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from ponderpounce.models.place_code import PLACE_PX
from ponderpounce.training.lapses import Words
from ponderpounce.training.places import PLACE

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


def stood_at(subgoals: Sequence[str]) -> list[str]:
    """Per tick, where the hand waits or waited, ``<y, x>``: what a text of waiting named last; empty before."""
    found: list[str] = []
    place = ""
    for text in subgoals:
        if _WAITING.search(text) and (told := PLACE.search(text)) is not None:
            place = told[0]
        found.append(place)
    return found


def waits_unplaced(subgoals: Sequence[str]) -> list[bool]:
    """Per tick, whether the hand waits, or does what it has waited for, without being told where it stands."""
    stood = stood_at(subgoals)
    return [
        bool(place) and not (_WAITING.search(text) and PLACE.search(text))
        for text, place in zip(subgoals, stood, strict=True)
    ]


def counted(words: Sequence[Words], subgoals: Sequence[str], left: Sequence[int | None]) -> tuple[Words, ...]:
    """The words of Q queries, with the steps that are ``left`` wherever a subgoal without a place is waited out."""
    return tuple(
        each if wait is None or PLACE.search(text) else Words(text=f"{text} {wait}", is_due=True)
        for each, text, wait in zip(words, subgoals, left, strict=True)
    )


def as_place(wait: int) -> str:
    """The wait as a place."""
    return f"<0, {min(wait, _LONGEST)}>"
