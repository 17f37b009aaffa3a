"""Rows in which a recorded PONDER's own words stand, right and wrong, and are put right.

What was played is followed with the simulator's words elsewhere (`pp-train --watch`): PONDER sees where its errors lead
and not the words that led there. In serving they stand in its context: "put it into the bin" where nothing was picked
up, and a plan of three cubes where four are asked for; it reads them and goes on from them. Here the recording's own
words stand where they were said, and are not learned; where others are in force those are owed, and after a while they
come and are learned. `lapses` draws such errors, these were made.

That is DAgger (Ross et al. 2011) for words; the paper has nothing of it.
"""

# Q queries

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from dual_system.models.ponder.coordinates import pixel_text
from dual_system.training.lapses import Words, is_other
from dual_system.training.places import PARTS


def as_recorded(said: str) -> str:
    """A PONDER's words, with places as the simulator's texts tell them; empty if one lies outside of the picture."""
    try:
        return pixel_text(said)
    except ValueError:
        return ""


def newly_said(said: Sequence[str], ticks: Sequence[int], has_demo: bool) -> list[str]:
    """The last words of a recorded PONDER, ``said`` tick by tick, since the query before. After a demonstration the
    first ones are left out: they followed from what it wrote about it, which no row holds."""
    newest = [
        next((text for text in reversed(said[before + 1 : tick + 1]) if text), "")
        for before, tick in pairwise([-1, *ticks])
    ]
    return ["", *newest[1:]] if has_demo else newest


def own_words(
    said: Sequence[str], subgoals: Sequence[str], is_change: Sequence[bool], rng: np.random.Generator, corrected: float
) -> tuple[Words, ...]:
    """Words of Q queries: those that were said, until they are put right.

    Words are owed where those that were said last speak of another subgoal than the one in force, and where it begins
    anew. What is owed comes at a query with a chance of ``corrected``; until then the recording's words stand, or its
    silence. Right ones come as they are to be; those whose plan alone is another may stand, too.

    Args:
        said: what the recorded PONDER newly said at each query, places in pixels; ``""`` for nothing.
        subgoals: what is to be said there.
        is_change: whether the query is the first to see a change.
        rng: one number is drawn for each query.
        corrected: from 0 to 1. With 1 every word is right, as without errors; with 0 nothing is put right.
    """
    words: list[Words] = []
    last, before, is_anew = "", "", False
    for index, (own, text, changes) in enumerate(zip(said, subgoals, is_change, strict=True)):
        is_anew |= changes and speaks_of(before, text)
        before = text
        is_due = bool(text) and (is_anew or not speaks_of(last, text))
        is_put_right = rng.random() < corrected or (index == 0 and not own)  # nothing is late at the first query
        if is_due and (is_put_right or not is_other(own, text)):
            words.append(Words(text=text, is_due=True))
        elif is_put_right or not own:
            words.append(Words(is_due=is_due))
        else:
            words.append(Words(text=own, is_due=is_due, is_learned=False))
        if words[-1].text:
            last, is_anew = words[-1].text, False
    return tuple(words)


def speaks_of(said: str, text: str) -> bool:
    """Whether both tell one subgoal, whatever they plan after it: the same words, and places that are the same."""
    return not is_other(_subgoal(said), _subgoal(text))


def _subgoal(text: str) -> str:
    """The text without its plan."""
    end = PARTS.search(text)
    return text if end is None else text[: end.start()]
