"""Words that come late, or are wrong, and are put right: a PONDER that errs has to go on from what it said.

In a row made from a recording every subgoal is told by the first query that sees it. A PONDER that misses a change, or
speaks of the wrong thing, then reads a row such as it has never learned from, and nothing has taught it that the right
words are still owed. So some rows are made to err: a change is passed over in silence for a few queries, or words of
another subgoal of the same episode are said when nothing changed. The errors themselves are not learned: where PONDER
should have spoken, or should have been silent, that is its label, and the words that put it right are learned.

The paper has nothing of it; it is to words what DAgger (Ross et al. 2011) is to actions.
"""

# Q queries

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ponderpounce.training.places import PLACE

_APART_PX = 16.0  # texts that differ by their places alone: less than that is the same thing, pushed


@dataclass(frozen=True, slots=True, kw_only=True)
class Lapses:
    """How often PONDER is made to have erred."""

    rows: float = 0.0
    """Share of grounded rows in which anything lapses."""
    missed: float = 0.3
    """In these, the share of changes that are told late, and"""
    wrong: float = 0.05
    """of other queries at which something else is said."""
    longest: int = 3
    """Queries until it is put right: from 1 up to so many, each as likely."""

    def __post_init__(self) -> None:
        for name in ("rows", "missed", "wrong"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in [0, 1], came {getattr(self, name)}")
        if self.longest < 1:
            raise ValueError(f"longest must be at least 1, came {self.longest}")


NO_LAPSES = Lapses()


@dataclass(frozen=True, slots=True, kw_only=True)
class Words:
    """What stands at one query of a row."""

    text: str = ""
    """Empty: nothing is said."""
    is_due: bool = False
    """Whether anything should be."""


def without_lapses(subgoals: Sequence[str], is_change: Sequence[bool]) -> tuple[Words, ...]:
    """Every change is told when it is seen: `drawn_lapses` without any."""
    return tuple(
        Words(text=text, is_due=True) if changes and text else Words()
        for text, changes in zip(subgoals, is_change, strict=True)
    )


def drawn_lapses(
    lapses: Lapses, subgoals: Sequence[str], is_change: Sequence[bool], rng: np.random.Generator
) -> tuple[Words, ...]:
    """Words of Q queries, ``subgoals`` in force at each and whether it is the first to see a change.

    The first query errs never. A change ends what lapsed before it, also by making it true.
    """
    known = [text for text, changes in zip(subgoals, is_change, strict=True) if changes and text]
    words: list[Words] = []
    wait: int | None = None  # queries until the words that are owed come; None: none are
    mistaken = ""
    for index, (text, changes) in enumerate(zip(subgoals, is_change, strict=True)):
        others = [other for other in known if _is_other(other, text)]
        if changes and mistaken and not _is_other(mistaken, text):
            wait = None
        elif changes:
            is_late = index > 0 and rng.random() < lapses.missed
            wait = int(rng.integers(1, lapses.longest + 1)) if is_late else 0
        elif wait is not None:
            wait -= 1
        elif text and others and rng.random() < lapses.wrong:
            mistaken = str(rng.choice(others))
            words.append(Words(text=mistaken))
            wait = int(rng.integers(1, lapses.longest + 1))
            continue
        is_owed = wait is not None and bool(text)
        words.append(Words(text=text if wait == 0 else "", is_due=is_owed))
        if wait == 0:
            wait = None
        if wait is None:
            mistaken = ""
    return tuple(words)


def _is_other(text: str, than: str) -> bool:
    """Whether it is of another subgoal: other words, or places that are further apart than things are pushed."""
    if PLACE.sub("", text) != PLACE.sub("", than):
        return True
    pairs = zip(PLACE.findall(text), PLACE.findall(than), strict=False)
    return any(np.hypot(int(y) - int(v), int(x) - int(u)) > _APART_PX for (y, x), (v, u) in pairs)
