"""Ways around things as PONDER tells them: on which side one is passed as a picture shows it, before which way round.

The simulator says "left" and "clockwise", and of what comes later only "clockwise". That is "backward", as it is seen
half-way, or "forward", depending on where the stretch leads. A small network's notes of a demonstration were right, and
the sides of the plan that it made of them were not. So the plan keeps the words of the notes, to be copied, and which
way round is told of the stretch that is gone and the next one alone, behind the two words that it follows from.

Stretches around things are told by their numbers, in notes and in plans: a way comes back to where it was, and by its
place alone a stretch was taken for another one that begins there. A recipe has to ask for it (docs/training.md, "Looked
up"). Ways that lead around nothing were told worse with numbers than without (there, "A fovea").
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from functools import lru_cache
from itertools import count, pairwise

from dual_system.training.places import PLACE, WAY

_AROUND = re.compile(
    r"(?P<until>.*\b(?P<lead>left|right) target by circling around the stick )(?P<way>(?:counter)?clockwise to <.*)"
)
_STRETCH = re.compile(rf"((?:counter)?clockwise) (?:to )?{PLACE.pattern}")
_TURN = re.compile(r"(?:counter)?clockwise")
_NOTED = re.compile(r"((\d+) (?:left|right) )(backward|forward)")
_OTHER = {"clockwise": "counterclockwise", "backward": "forward"}
_OTHER |= {other: one for one, other in _OTHER.items()}
_NUMBER = re.compile(r"(?<!\w)\d+ (?:(?:left|right) )?(?=(?:back|for)ward|left|right)")


def seen_side(leads: str, turn: str) -> str:
    """Whether a stretch that leads "left" or "right" and turns "clockwise" or "counterclockwise" passes its thing
    "backward", nearer to the robot, or "forward"."""
    return "backward" if (leads == "left") == (turn == "clockwise") else "forward"


@lru_cache(maxsize=1 << 12)
def by_sight(text: str, number: int) -> str:
    """The text of a way around things, or its plan, that begins with the stretch of this number; others unchanged.

    Every stretch is told with its number, where it leads, and the side on which it is seen to pass. Where it leads
    follows from its end and that of the one before, for the robot's left is the picture's right.
    """
    around = _AROUND.fullmatch(text)
    if around is None:
        return text
    stretches = [(each[1], int(each[2]), int(each[3])) for each in _STRETCH.finditer(around["way"])]
    leads = [around["lead"], *("left" if after[2] > before[2] else "right" for before, after in pairwise(stretches))]
    told = []
    for nth, (lead, (turn, y, x)) in enumerate(zip(leads, stretches, strict=True)):
        words = f"{number + nth} {lead} {seen_side(lead, turn)}" + (f" {turn} to" if nth < 2 else "")
        told.append(f"{'then ' if nth == 1 else ''}{words} <{y}, {x}>")
    return around["until"] + ", ".join(told)


def stretch_numbers(texts: Sequence[str]) -> list[int]:
    """Of every instant with these texts of the simulator's, the number of the last stretch that had begun; 0: none."""
    stretches = [found and (found[1], found[2]) for found in map(WAY.search, texts)]
    numbers: list[int] = []
    last = None
    for stretch in stretches:
        begins = stretch is not None and stretch != last
        numbers.append((numbers[-1] if numbers else 0) + begins)
        last = stretch
    return numbers


def shows_a_way(texts: Sequence[str]) -> bool:
    """Whether the simulator's texts tell a way, around things or not."""
    return any(WAY.search(text) for text in texts)


def has_sides(texts: Sequence[str]) -> bool:
    """Whether the simulator's texts tell a way around things."""
    return any(_TURN.search(text) for text in texts)


def turned_otherwise(text: str, number: int, others: Collection[int]) -> str:
    """The simulator's text of the stretch of this number and the next, each the other way round if of ``others``."""
    numbers = count(number)
    return _TURN.sub(lambda turn: _OTHER[turn[0]] if next(numbers) in others else turn[0], text)


def noted_otherwise(note: str, others: Collection[int]) -> str:
    """The note of a stretch, on the other side if it is one of ``others``."""
    return _NOTED.sub(lambda each: each[1] + (_OTHER[each[3]] if int(each[2]) in others else each[3]), note)


def without_numbers(told: str) -> str:
    """Notes or a narration of a way without its stretches' numbers, and without where those around things lead."""
    return _NUMBER.sub("", told)
