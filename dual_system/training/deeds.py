"""What a demonstration does, instant by instant: which deed, where, for which time, and where the one before.

The simulator's texts say what is being done now. What is asked for later is a deed by its number: the second target
that a cube was put onto, the one before the button was pressed, the next stretch of a way.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from dual_system.tasks.captions import ORDINALS
from dual_system.training.insertions import in_words, manner
from dual_system.training.lapses import has_moved
from dual_system.training.places import PLACE, WAY
from dual_system.training.ways import seen_side

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
    """Of the deed before this one; where things are only watched, of the second of them; of a peg, of its other end, or
    of the hole's other mouth."""


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
        other = _place(text, 1) if is_watched or manner(text) else _place(before)
        found.append(Deed(_name(text), counts[_name(text)], number, _place(text), other))
    return found


@dataclass(frozen=True, slots=True)
class Told:
    """One thing that a narration tells, and the instants of a demonstration in which it is done."""

    words: str
    """``second <y, x>``."""
    place: str
    """``<y, x>``; empty where the text tells none."""
    first: int
    last: int


def told_deeds(texts: Sequence[str]) -> list[Told]:
    """What was done where, in order; nothing where that is little.

    Things are put onto one place after the other, one is picked up, or a peg is held at one of its ends and put into a
    box from one side. Of a way every stretch counts: around things with its `course`, others with their last word, as
    plans tell them (`TrainingEpisode.with_plans`).
    """
    if stretches := _stretches(texts):
        return stretches
    puts: dict[int, Told] = {}
    picks: dict[int, Told] = {}
    for instant, deed in enumerate(deeds(texts)):
        place = "" if deed.place is None else "<{}, {}>".format(*deed.place)
        if deed.name.startswith(_PUT) and place and deed.count <= len(ORDINALS):
            there, words = puts, f"{ORDINALS[deed.count - 1]} {place}"
        elif deed.name.startswith(_PRESS):
            there, words = puts, "button"
        elif manner(texts[instant]) and place:
            there, words = puts, in_words(texts[instant])
        elif deed.name.startswith(_PICK) and place:
            there, words = picks, place
        else:
            continue
        first = there[deed.number].first if deed.number in there else instant
        there[deed.number] = Told(words, place, first, instant)
    told = puts if any(PLACE.search(each.words) for each in puts.values()) else picks
    return [told[number] for number in sorted(told)]


def narration(texts: Sequence[str]) -> str:
    """What was done where, in order: ``first <y, x>, second <y, x>, button, third <y, x>``; empty where that is little.

    Written down it can be looked up by number, or by what it stands beside, as often as one likes. A way that leads
    around nothing is told by its plan.
    """
    is_told_by_its_plan = any(WAY.search(text) and not passing_side(text) for text in texts)
    return "" if is_told_by_its_plan else ", ".join(told.words for told in told_deeds(texts))


def passing_side(text: str) -> str:
    """Whether the stretch of a way that the text tells passes its thing "backward", nearer to the robot, or "forward".

    That is where the tool is seen half-way. Which way round follows from it and from where the stretch leads, and was
    not learned without. Empty for other texts.
    """
    return course(text).partition(" ")[2]


def course(text: str) -> str:
    """Where the stretch of a way around things leads, and `passing_side`: "left backward". Empty for other texts."""
    found = _AROUND.search(text)
    return "" if found is None else f"{found[1]} {seen_side(found[1], found[2])}"


def _stretches(texts: Sequence[str]) -> list[Told]:
    """Every stretch of a way, with its number, its `course` or its last word, and its end."""
    found: list[Told] = []
    for instant, text in enumerate(texts):
        stretch = WAY.search(text)
        if stretch is None:
            continue
        words = f"{course(text) or stretch[1]} {stretch[2]}"
        if found and found[-1].words == f"{len(found)} {words}":
            found[-1] = replace(found[-1], last=instant)
        else:
            found.append(Told(f"{len(found) + 1} {words}", stretch[2], instant, instant))
    return found


def _name(text: str) -> str:
    return _AT.sub("", text)


def _place(text: str, nth: int = 0) -> Place | None:
    places = [(int(y), int(x)) for y, x in PLACE.findall(text)]
    return places[nth] if nth < len(places) else None
