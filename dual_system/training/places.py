"""Places as the simulator's texts tell them, ``<y, x>`` in pixels of a 256 px picture, and how to tell them wrongly."""

from __future__ import annotations

import re

import numpy as np

from dual_system.models.place_code import PLACE_PX
from dual_system.models.ponder.coordinates import YX_PX

PLACE = YX_PX
ONE_PLACE = PLACE.pattern.replace("(", "").replace(")", "")
"""The same for use within other patterns: it captures nothing."""
WAY = re.compile(rf"(\S+) to ({PLACE.pattern})(?:, then |$)")
"""A stretch of a way (`tasks.task.located`): how it is gone, in the last word, and where it ends."""
PARTS = re.compile(r", (?![^<]*>)")
"""Commas between the parts of a text, not those within places."""
TEXT_PX = PLACE_PX
"""Side of the picture that texts speak of, whatever the size of a picture."""
_NOT_AT_THE_EDGE = (32, 224)


def misplaced(text: str, std_px: float, rng: np.random.Generator, count: int = 0) -> str:
    """The text with coordinates wrong by a normal error, in the picture: of the first ``count`` places; 0: of all."""

    def slipped(place: re.Match[str]) -> str:
        y, x = (min(max(round(int(v) + rng.normal(0.0, std_px)), 0), TEXT_PX) for v in place.groups())
        return f"<{y}, {x}>"

    return PLACE.sub(slipped, text, count=count)


def scattered(text: str, seed: int) -> str:
    """The text with every place anywhere else but at a picture's edge; one place is always the same other one."""

    def elsewhere(place: re.Match[str]) -> str:
        y, x = np.random.default_rng([seed, *map(int, place.groups())]).integers(*_NOT_AT_THE_EDGE, size=2)
        return f"<{y}, {x}>"

    return PLACE.sub(elsewhere, text)


def apart_px(text: str, other: str) -> float | None:
    """How far apart the first places of two texts are; None where one of them tells none."""
    first, second = PLACE.search(text), PLACE.search(other)
    if first is None or second is None:
        return None
    return float(np.hypot(int(first[1]) - int(second[1]), int(first[2]) - int(second[2])))
