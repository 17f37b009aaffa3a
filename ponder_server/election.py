"""What several readings of one episode agree on, from what each has said of it: a rule, without tensors.

Texts are those of `counsel`, told of the scene as it is. Whether to speak is decided by most; of those who speak the
one is heard that agrees best with all others (the medoid), and its places are moved to the middle of those that are
meant.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TypeAlias

from dual_system.models.ponder.coordinates import XY_1000

Said: TypeAlias = tuple[str, ...]
"""The texts of one answer, the subgoal last; () for silence."""

_NUMBER = re.compile(r"\d+")
_NEAR_WAIT = 10  # control steps
_MOST_ALIKE = 2.0


def elected(said: Sequence[Said], near: int) -> Said:
    """The answer of all, from each one's; whoever comes first has it where they are equal.

    Args:
        near: Thousandths of the picture: places nearer than that are the same.
    """
    speaking = [texts for texts in said if texts]
    num_silent = len(said) - len(speaking)
    if num_silent > len(speaking) or (num_silent == len(speaking) and not said[0]):
        return ()
    support = [sum(_likeness(texts, other, near) for other in speaking) for texts in speaking]
    chosen = speaking[support.index(max(support))]
    alike = [texts for texts in speaking if len(texts) == len(chosen)]
    return tuple(_centred(text, [texts[n] for texts in alike], near) for n, text in enumerate(chosen))


def elected_place(found: Sequence[Said], near: int, num_readings: int) -> Said:
    """What second looks have found, where more than half of all readings found it; else ()."""
    place = elected(found, near) if found else ()
    agreeing = sum(_likeness(place, other, near) == _MOST_ALIKE for other in found)
    return place if 2 * agreeing > num_readings else ()


def _likeness(texts: Said, other: Said, near: int) -> float:
    """Of two answers, 2 at most; the subgoal counts, and what comes before it half as much."""
    pairs = zip(reversed(texts), reversed(other), strict=False)
    alike = sum(_alike(text, another, near) / (1 + n) for n, (text, another) in enumerate(pairs))
    return alike / sum(1 / (1 + n) for n in range(max(len(texts), len(other))))


def _alike(text: str, other: str, near: int) -> float:
    """1 for the same words, and the share of their numbers that are the same."""
    mine, theirs = _numbers(text), _numbers(other)
    num = max(len(mine), len(theirs))
    same = sum(_is_same(a, b, near) for a, b in zip(mine, theirs, strict=False))
    return float(_words(text) == _words(other)) + (same / num if num else 1.0)


def _centred(text: str, others: Sequence[str], near: int) -> str:
    """The text with each place in the middle of those that are near it in the same words."""
    alike = [XY_1000.findall(other) for other in others if _words(other) == _words(text)]
    count = iter(range(len(text)))

    def middle(place: re.Match[str]) -> str:
        n, own = next(count), (int(place[1]), int(place[2]))
        there = [(int(places[n][0]), int(places[n][1])) for places in alike]
        there = [each for each in there if _is_same(each, own, near)]
        x, y = (round(sum(each[axis] for each in there) / len(there)) for axis in (0, 1))
        return f"[{x}, {y}]"

    return XY_1000.sub(middle, text)


def _words(text: str) -> str:
    """All but its numbers."""
    return _NUMBER.sub("#", text)


def _numbers(text: str) -> list[tuple[int, ...]]:
    """Places as pairs, then all other numbers."""
    places: list[tuple[int, ...]] = [(int(x), int(y)) for x, y in XY_1000.findall(text)]
    return [*places, *((int(number),) for number in _NUMBER.findall(XY_1000.sub("", text)))]


def _is_same(a: tuple[int, ...], b: tuple[int, ...], near: int) -> bool:
    if len(a) != len(b):
        return False
    if len(a) == 1:
        return abs(a[0] - b[0]) < _NEAR_WAIT
    return sum((p - q) ** 2 for p, q in zip(a, b, strict=True)) < near**2
