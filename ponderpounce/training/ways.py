"""Ways around things as PONDER tells them: on which side one is passed as a picture shows it, before which way round.

The simulator says "left" and "clockwise", and of what comes later only "clockwise". That is "backward", as it is seen
half-way, or "forward", depending on where the stretch leads. A small network's notes of a demonstration were right, and
the sides of the plan that it made of them were not. So the plan keeps the words of the notes, to be copied, and which
way round is told of the stretch that is gone and the next one alone, behind the two words that it follows from.
"""

from __future__ import annotations

import re
from functools import lru_cache
from itertools import pairwise

from ponderpounce.training.places import PLACE

_AROUND = re.compile(
    r"(?P<until>.*\b(?:left|right) target by circling around the stick )(?P<way>(?:counter)?clockwise to <.*)"
)
_STRETCH = re.compile(rf"((?:counter)?clockwise) (?:to )?{PLACE.pattern}")
_LEADS = re.compile(r"(left|right) target by circling")


def seen_side(leads: str, turn: str) -> str:
    """Whether a stretch that leads "left" or "right" and turns "clockwise" or "counterclockwise" passes its thing
    "backward", nearer to the robot, or "forward"."""
    return "backward" if (leads == "left") == (turn == "clockwise") else "forward"


@lru_cache(maxsize=1 << 12)
def with_seen_sides(text: str) -> str:
    """The text of a way around things, or its plan, told with the sides on which it is seen to pass; others unchanged.

    Where a stretch leads follows from its end and that of the one before: the robot's left is the picture's right.
    """
    around = _AROUND.fullmatch(text)
    if around is None:
        return text
    stretches = [(each[1], int(each[2]), int(each[3])) for each in _STRETCH.finditer(around["way"])]
    (first,) = _LEADS.findall(around["until"])
    leads = [first, *("left" if after[2] > before[2] else "right" for before, after in pairwise(stretches))]
    told = []
    for nth, (lead, (turn, y, x)) in enumerate(zip(leads, stretches, strict=True)):
        words = seen_side(lead, turn) if nth > 1 else f"{seen_side(lead, turn)} {turn} to"
        told.append(f"{f'then {lead} ' if nth == 1 else ''}{words} <{y}, {x}>")
    return around["until"] + ", ".join(told)
