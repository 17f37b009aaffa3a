"""A second look: where something is, is read anew when words about it have stood for long and nothing came of them.

PONDER says a place once and from then on reads it in its own words. If it was wrong, or the thing has been pushed, the
hand tries there until the time is over: a context that holds its own error repeats it. So the words are completed once
more in a context that holds nothing but the instruction and the newest observation, as if the episode began with it,
and if another place comes out they are said again with that one. What only memory knows cannot be seen in one look:
``unless`` names it.

The paper has nothing of it; its 9B model is trusted to put its words right.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from dual_system.models.ponder.coordinates import XY_1000


@dataclass(frozen=True, slots=True, kw_only=True)
class SecondLook:
    """When a PONDER looks again; part of its checkpoint."""

    after: int
    """Queries for which words must have stood, and between two second looks."""
    least: int
    """Thousandths of the picture: what is nearer is the same place."""
    unless: str = ""
    """Regular expression of words about what cannot be seen, only remembered; empty: all can be seen."""

    def __post_init__(self) -> None:
        if self.after < 1:
            raise ValueError(f"after must be at least 1 query, came {self.after}")
        if self.least < 1:
            raise ValueError(f"least must be at least 1 thousandth, came {self.least}")
        try:
            re.compile(self.unless)
        except re.error as error:
            raise ValueError(f"unless is no regular expression: {error} in {self.unless!r}") from None

    def can_answer(self, text: str) -> bool:
        """Whether one look can tell the first place of this text."""
        return XY_1000.search(text) is not None and not (self.unless and re.search(self.unless, text))

    def is_another(self, before: str, anew: str) -> bool:
        """Whether two texts' first places are not the same one; False where one of them has none."""
        places = [XY_1000.search(text) for text in (before, anew)]
        if any(place is None for place in places):
            return False
        (x, y), (u, v) = ((int(place[1]), int(place[2])) for place in places if place is not None)
        return (x - u) ** 2 + (y - v) ** 2 >= self.least**2

    def about(self, text: str) -> str:
        """A text's words in front of its first place."""
        place = XY_1000.search(text)
        return text if place is None else text[: place.start()]
