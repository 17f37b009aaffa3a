"""What a demonstration does, instant by instant: which deed, where, for which time, and where the one before.

The simulator's texts say what is being done now. What is asked for later is a deed by its number: the second target
that a cube was put onto, the one before the button was pressed, the next stretch of a way.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from ponderpounce.training.lapses import has_moved
from ponderpounce.training.places import PLACE

_OTHER_PX = 6.0  # of a 256 px picture: less than any two things lie apart

_AT = re.compile(rf" (?:at|to) {PLACE.pattern}(?:, then .*)?")

Place = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Deed:
    """What is going on at one instant."""

    name: str
    """The text without its coordinates."""
    count: int
    """It is done for so many times by now, this one included."""
    number: int
    """Of all that is done, counted from 1."""
    place: Place | None
    """Row and column; None where the text tells none."""
    place_before: Place | None
    """Of the deed before this one."""


def deeds(texts: Sequence[str]) -> list[Deed]:
    """The deed at every instant of a demonstration with these grounded texts.

    A text that gets its place while it lasts, when the arm no longer hides the thing, is the same deed; one of the same
    words with another place is the next.
    """
    found: list[Deed] = []
    counts: Counter[str] = Counter()
    number, before, last = 0, "", ""
    for text in texts:
        if not last or _name(text) != _name(last) or has_moved(last, text, _OTHER_PX):
            counts[_name(text)] += 1
            number, before = number + 1, last
        last = text
        found.append(Deed(_name(text), counts[_name(text)], number, _place(text), _place(before)))
    return found


def _name(text: str) -> str:
    return _AT.sub("", text)


def _place(text: str) -> Place | None:
    place = PLACE.search(text)
    return (int(place[1]), int(place[2])) if place else None
