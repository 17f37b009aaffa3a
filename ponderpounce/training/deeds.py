"""What a demonstration does, instant by instant: which deed, where, for which time, and where the one before.

The simulator's texts say what is being done now. What is asked for later is a deed by its number: the second target
that a cube was put onto, the one before the button was pressed, the next stretch of a way.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from ponderpounce.tasks.captions import ORDINALS
from ponderpounce.training.lapses import has_moved
from ponderpounce.training.places import PLACE, WAY

_OTHER_PX = 6.0  # of a 256 px picture: less than any two things lie apart

_AT = re.compile(rf" (?:at|to) {PLACE.pattern}(?:, then .*|, {PLACE.pattern})?")
# what `Environment._watching` makes of a text without a place
_WATCHED = re.compile(rf"[^<]* at {PLACE.pattern}, {PLACE.pattern}|static at {PLACE.pattern}")
_AROUND = re.compile(r"(left|right) target by circling around the stick (clockwise|counterclockwise)")
_PUT, _PRESS, _PICK = "drop the cube onto target", "press the button", "pick up the"

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
    """Of the deed before this one; where things are only watched, of the second of them."""


def deeds(texts: Sequence[str]) -> list[Deed]:
    """The deed at every instant of a demonstration with these grounded texts.

    A text that gets its place while it lasts, when the arm no longer hides the thing, is the same deed; one of the same
    words with another place is the next. What is only watched (`Environment` tells where it is meanwhile) is one deed
    wherever it moves.
    """
    found: list[Deed] = []
    counts: Counter[str] = Counter()
    number, before, last = 0, "", ""
    for text in texts:
        is_watched = _WATCHED.fullmatch(text) is not None
        is_other = not is_watched and has_moved(last, text, _OTHER_PX)
        if not last or _name(text) != _name(last) or is_other:
            counts[_name(text)] += 1
            number, before = number + 1, last
        last = text
        other = _place(text, 1) if is_watched else _place(before)
        found.append(Deed(_name(text), counts[_name(text)], number, _place(text), other))
    return found


def narration(texts: Sequence[str]) -> str:
    """What was done where, in order: ``first <y, x>, second <y, x>, button, third <y, x>``; empty where that is little.

    Things are put onto one place after the other, or one is picked up. Written down it can be looked up by number, or
    by what it stands beside, as often as one likes. Of a way around things every stretch is told with the side on which
    it passes (`passing_side`); other ways are told by their plan (`TrainingEpisode.with_plans`).
    """
    if around := [f"{side} {place}" for side, place in _around(texts)]:
        return ", ".join(around)
    told: dict[int, str] = {}
    picked: dict[int, str] = {}
    for deed in deeds(texts):
        place = None if deed.place is None else "<{}, {}>".format(*deed.place)
        if deed.name.startswith(_PUT) and place and deed.count <= len(ORDINALS):
            told[deed.number] = f"{ORDINALS[deed.count - 1]} {place}"
        elif deed.name.startswith(_PRESS):
            told[deed.number] = "button"
        elif deed.name.startswith(_PICK) and place:
            picked[deed.number] = place
    if not any(PLACE.search(text) for text in told.values()):
        told = picked
    return ", ".join(told[number] for number in sorted(told))


def passing_side(text: str) -> str:
    """Whether the stretch of a way that the text tells passes its thing "backward", nearer to the robot, or "forward".

    That is where the tool is seen half-way. Which way round follows from it and from where the stretch leads, and was
    not learned without. Empty for other texts.
    """
    found = _AROUND.search(text)
    if found is None:
        return ""
    return "backward" if (found[1] == "left") == (found[2] == "clockwise") else "forward"


def _around(texts: Sequence[str]) -> list[tuple[str, str]]:
    """Side and end, ``<y, x>``, of every stretch of a way around things."""
    found: list[tuple[str, str]] = []
    for text in texts:
        stretch = WAY.search(text)
        if (side := passing_side(text)) and stretch is not None and (side, stretch[2]) not in found[-1:]:
            found.append((side, stretch[2]))
    return found


def _name(text: str) -> str:
    return _AT.sub("", text)


def _place(text: str, nth: int = 0) -> Place | None:
    places = [(int(y), int(x)) for y, x in PLACE.findall(text)]
    return places[nth] if nth < len(places) else None
