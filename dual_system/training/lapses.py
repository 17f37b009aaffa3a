"""Words that come late, or are wrong, and are put right: a PONDER that errs has to go on from what it said.

In a row made from a recording every subgoal is told by the first query that sees it. A PONDER that misses a change, or
speaks of the wrong thing, then reads a row such as it has never learned from, and nothing has taught it that the right
words are still owed. So some rows are made to err: a change is passed over in silence for a few queries, words of
another subgoal of the same episode are said when nothing changed, or a place is told beside its thing. The errors
themselves are not learned: where PONDER should have spoken, or should have been silent, that is its label, and the
words that put it right are learned.

A place can also be another thing's, or have one number of it (``elsewhere``): copied from a plan that was wrong from
the start, it is where a hand tries in vain until the episode's time is over. Said of the subgoal in force it is put
right like other wrong words; in what is planned it stands, and when its turn comes the right one is learned.

A place can be wrong without an error: the thing was pushed. With ``retold_px`` words are owed again as soon as the
place that they tell lies that far from where the thing is, for whichever reason. Cognition then never has to follow
farther than that.

The paper has nothing of it; it is to words what DAgger (Ross et al. 2011) is to actions.
"""

# Q queries

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dual_system.training.places import PLACE, apart_px, misplaced

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
    slipped: float = 0.0
    """Of all that is said, the share whose own place is wrong by ``slip_px``; put right only with a ``retold_px``."""
    slip_px: tuple[float, float] = (3.0, 24.0)
    """Standard deviation of each coordinate, of a 256 px picture: from the first to the second, log-uniform."""
    elsewhere: float = 0.0
    """Of all that is said, the share in which one place, its own or a planned one, is another thing's of the episode,
    or has one number of that."""
    longest: int = 3
    """Queries until it is put right: from 1 up to so many, each as likely."""

    def __post_init__(self) -> None:
        for name in ("rows", "missed", "wrong", "slipped", "elsewhere"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in [0, 1], came {getattr(self, name)}")
        if self.longest < 1:
            raise ValueError(f"longest must be at least 1, came {self.longest}")
        if not 0 < self.slip_px[0] <= self.slip_px[1]:
            raise ValueError(f"slip_px {self.slip_px} must ascend from above 0")


NO_LAPSES = Lapses(missed=0.0, wrong=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Words:
    """What stands at one query of a row."""

    text: str = ""
    """Empty: nothing is said."""
    is_due: bool = False
    """Whether anything should be."""
    is_learned: bool = True
    """False: a place is wrong; that something is said is learned, what is said is not."""


def without_lapses(subgoals: Sequence[str], is_change: Sequence[bool]) -> tuple[Words, ...]:
    """Every change is told when it is seen: `drawn_lapses` without any."""
    return tuple(
        Words(text=text, is_due=True) if changes and text else Words()
        for text, changes in zip(subgoals, is_change, strict=True)
    )


def drawn_lapses(
    lapses: Lapses,
    subgoals: Sequence[str],
    is_change: Sequence[bool],
    rng: np.random.Generator,
    retold_px: float | None = None,
) -> tuple[Words, ...]:
    """Words of Q queries, ``subgoals`` in force at each and whether it is the first to see a change.

    The first query is never late. A change ends what lapsed before it, also by making it true. ``retold_px``: words are
    also owed where the first place that was told last is farther than that from the subgoal's; None: never.
    """
    known = [text for text, changes in zip(subgoals, is_change, strict=True) if changes and text]
    places = [match[0] for text in known for match in PLACE.finditer(text)]
    words: list[Words] = []
    wait: int | None = None  # queries until the words that are owed come; None: none are
    mistaken = ""
    last = ""  # of all words that stand there
    for index, (text, changes) in enumerate(zip(subgoals, is_change, strict=True)):
        others = [other for other in known if is_other(other, text)]
        if changes and mistaken and not is_other(mistaken, text):
            wait = None
        elif changes or (wait is None and retold_px is not None and has_moved(last, text, retold_px)):
            is_late = index > 0 and rng.random() < lapses.missed
            wait = int(rng.integers(1, lapses.longest + 1)) if is_late else 0
        elif wait is not None:
            wait -= 1
        elif text and others and rng.random() < lapses.wrong:
            last = mistaken = str(rng.choice(others))
            words.append(Words(text=mistaken))
            wait = int(rng.integers(1, lapses.longest + 1))
            continue
        is_owed = wait is not None and bool(text)
        if wait == 0:
            last, is_right = _said(text, places, lapses, rng)
            words.append(Words(text=last, is_due=is_owed, is_learned=is_right))
            wait = None
            if lapses.elsewhere and is_other(_own(last), _own(text)):
                mistaken = last
                wait = int(rng.integers(1, lapses.longest + 1))
        else:
            words.append(Words(is_due=is_owed))
        if wait is None:
            mistaken = ""
    return tuple(words)


def _said(text: str, places: Sequence[str], lapses: Lapses, rng: np.random.Generator) -> tuple[str, bool]:
    """The words, and whether they are right. ``places``: all of the episode."""
    if text and lapses.elsewhere and rng.random() < lapses.elsewhere:
        said = _elsewhere(text, places, rng)
        return said, said == text
    if not lapses.slipped or rng.random() >= lapses.slipped or PLACE.search(text) is None:
        return text, True
    said = misplaced(text, float(np.exp(rng.uniform(*np.log(lapses.slip_px)))), rng, count=1)
    return said, said == text  # at the edge of the picture, or by chance, it may be right all the same


def _elsewhere(text: str, places: Sequence[str], rng: np.random.Generator) -> str:
    """The text with one of its places as another of ``places``, or with the one or the other number of that."""
    told = list(PLACE.finditer(text))
    if not told:
        return text
    # as often the subgoal's own as any of the plan
    place = told[0] if rng.random() < 0.5 else told[int(rng.integers(len(told)))]
    others = [other for other in places if has_moved(other, place[0], _APART_PX)]
    if not others:
        return text
    (v, u), (y, x) = PLACE.findall(str(rng.choice(others)))[0], place.groups()
    wrong = str(rng.choice([f"<{v}, {u}>", f"<{v}, {u}>", f"<{v}, {x}>", f"<{y}, {u}>"]))
    return f"{text[: place.start()]}{wrong}{text[place.end() :]}"


def _own(text: str) -> str:
    """The text up to its first place: what is planned comes later."""
    place = PLACE.search(text)
    return text if place is None else text[: place.end()]


def has_moved(told: str, now: str, by_px: float) -> bool:
    """Whether the first place of both is farther away than that."""
    found_px = apart_px(told, now)
    return found_px is not None and found_px > by_px


def is_other(text: str, than: str) -> bool:
    """Whether it is of another subgoal: other words, or places that are further apart than things are pushed."""
    if PLACE.sub("<>", text) != PLACE.sub("<>", than):
        return True
    pairs = zip(PLACE.findall(text), PLACE.findall(than), strict=True)
    return any(np.hypot(int(y) - int(v), int(x) - int(u)) > _APART_PX for (y, x), (v, u) in pairs)
