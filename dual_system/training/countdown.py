"""How long there is to wait: what a stand-in tells a hand that is to act on the second.

Where something is to be done at one instant (StopCube), a subgoal that begins when it is due comes too late. A
cognition is looked at for up to 2.3 s after its picture was taken, and the hand knows its age: so it has to tell how
long there was still to wait then. Told in control steps, as the second coordinate of a place.

PONDER says the number, too, once a second: the next one is the last one less 20, which is learned sooner than what is
to be waited for. Too soon: where the last one is always right nothing else is learned, and a first guess is counted
down to its end. So in some rows the first numbers are those of a rhythm half, or twice as fast, and are put right later
(`misjudged`); and which rhythm it is is a lesson of its own (`rhythm`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dual_system.models.place_code import PLACE_PX
from dual_system.tasks.captions import ORDINALS
from dual_system.tasks.paces import PASS_STEPS, PRESS_STEPS
from dual_system.training.lapses import Words
from dual_system.training.places import PLACE

_WAITING = re.compile(r"^remain static$| to prepare$")
LONGEST = PLACE_PX - 1
"""Wait that can be told as a place, in control steps."""
_PASSES = re.compile(r"just as it reaches the target for the (\w+) time")
_MISJUDGED = (0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0)


def is_waiting(text: str) -> bool:
    """Whether it is a subgoal that is waited out."""
    return _WAITING.search(text) is not None


def waits(subgoals: Sequence[str]) -> list[int | None]:
    """Per tick of an episode, how many there are until it no longer waits; None where it does not, or never ends."""
    found: list[int | None] = []
    left: int | None = None
    for text in reversed(subgoals):
        if not is_waiting(text):
            left = 0
            found.append(None)
            continue
        left = None if left is None else left + 1
        found.append(left)
    return found[::-1]


def waiting_longer(
    subgoals: Sequence[str], is_transition_T: NDArray[np.bool_], ticks: int
) -> tuple[list[str], NDArray[np.bool_]]:
    """Texts and transitions of an episode whose waits all end so many ticks later, or with it.

    Who hears "press" presses at once, as if it had been pressing since the last query; and so comes too early.
    """
    texts, begins_T = [*subgoals], is_transition_T.copy()
    left = waits(subgoals)
    for tick in range(1, len(texts)):
        if left[tick - 1] == 1:
            until = min(tick + ticks, len(texts) - 1)
            texts[tick:until] = [texts[tick - 1]] * (until - tick)
            begins_T[tick:until], begins_T[until] = False, True
    return texts, begins_T


def stood_at(subgoals: Sequence[str]) -> list[str]:
    """Per tick, where the hand waits or waited, ``<y, x>``: what a text of waiting named last; empty before."""
    found: list[str] = []
    place = ""
    for text in subgoals:
        if is_waiting(text) and (told := PLACE.search(text)) is not None:
            place = told[0]
        found.append(place)
    return found


def waits_unplaced(subgoals: Sequence[str]) -> list[bool]:
    """Per tick, whether the hand waits, or does what it has waited for, without being told where it stands."""
    stood = stood_at(subgoals)
    return [
        bool(place) and not (is_waiting(text) and PLACE.search(text))
        for text, place in zip(subgoals, stood, strict=True)
    ]


def counted(
    words: Sequence[Words],
    subgoals: Sequence[str],
    left: Sequence[int | None],
    wrong: Sequence[int | None] | None = None,
) -> tuple[Words, ...]:
    """The words of Q queries, with the steps that are ``left`` wherever a subgoal without a place is waited out.

    Where ``wrong`` has a number it stands in the other's stead, not to be learned (`misjudged`).
    """
    told = []
    for each, text, wait, other in zip(words, subgoals, left, wrong or [None] * len(words), strict=True):
        if not _is_counted(text, wait):
            told.append(each)
        elif other is None:
            told.append(Words(text=f"{text} {wait}", is_due=True))
        else:
            told.append(Words(text=f"{text} {other}", is_due=True, is_learned=False))
    return tuple(told)


def misjudged(
    ticks: Sequence[int], subgoals: Sequence[str], left: Sequence[int | None], rng: np.random.Generator
) -> list[int | None]:
    """Per query, the wrong number of steps that is told there; None: the right one.

    The first ones of those that are counted, at least one, as if all went so many times as fast.
    """
    counted_at = [n for n, (text, wait) in enumerate(zip(subgoals, left, strict=True)) if _is_counted(text, wait)]
    found: list[int | None] = [None] * len(ticks)
    if not counted_at:
        return found
    until = int(rng.integers(1, len(counted_at) + 1))
    at = [(n, ticks[n], ticks[n] + (left[n] or 0)) for n in counted_at[:until]]
    possible = [share for share in _MISJUDGED if all(share * due > tick for _, tick, due in at)]
    share = float(rng.choice(possible))
    for n, tick, due in at:
        found[n] = round(share * due) - tick
    return found


def _is_counted(text: str, wait: int | None) -> bool:
    return wait is not None and PLACE.search(text) is None


def rhythm(instruction: str, subgoals: Sequence[str]) -> int | None:
    """How many steps each pass takes of the thing that is to be stopped when it comes by for the n-th time.

    It starts at the end of a pass, and is where it is to be stopped after half of one and every one that follows. None
    where nothing comes by, or it is never stopped.
    """
    asked = _PASSES.search(instruction)
    left = waits(subgoals)
    if asked is None or left[0] is None:
        return None
    steps = (left[0] + PRESS_STEPS) / (ORDINALS.index(asked[1]) + 0.5)  # the press begins before the instant
    return min(PASS_STEPS, key=lambda each: abs(each - steps))


def told_until(text: str, after: str, wait: int) -> tuple[str, str]:
    """A subgoal that is waited out and the place after it; how long is told as its place, or after it if it has one."""
    return (text, as_place(wait)) if PLACE.search(text) else (f"{text} until {as_place(wait)}", after)


def as_place(wait: int) -> str:
    """The wait as a place."""
    return f"<0, {min(wait, LONGEST)}>"
