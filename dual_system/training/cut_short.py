"""Counting episodes told to end sooner: after so many rounds as the instruction then asks for.

Whether to go on or to stop is said once in an episode, in a few words of hundreds; a small network goes by what is
likely and hardly looks at the instruction. But an episode of four rounds is one of two, too, up to the end of its
second: with another count in its instruction, what is due there is what came at its own end. It is shown for a second
more, and then no further, because the arm did otherwise.

The paper has nothing of it; a pretrained model reads its instruction.
"""

# T ticks of an episode, U of one that was cut short

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dual_system.tasks.captions import COUNTS, counted_cubes

_MORE_TICKS = 25  # a query a second: one at least sees that a round has ended

_ROUND = re.compile(r"for the (?P<nth>\w+) time\b|^pick up the (?P<which>\w+) (?P<color>\w+) cube\b")
_NO_MORE = re.compile(r"^press the button\b|^put the \w+ cube on the table\b")
_BIN = re.compile(r"(?<=^put ).+(?= into the bin)")
_BINNED = re.compile(r"(\w+) (\w+) cubes?")
_SWINGS = re.compile(r"move it to the top of the (\S+) target, repeating this back-and-forth motion (\w+) times")
_REPEATS = re.compile(r", repeating this action (\w+) times")


class Cut(NamedTuple):
    """One way to end sooner."""

    instruction: str
    ticks_U: NDArray[np.intp]
    """Of the episode: up to a second after the last round, then what comes after all rounds."""
    subgoals: tuple[str, ...]
    is_transition_U: NDArray[np.bool_]
    end: int
    """From this tick on the episode's arm did not do what is told here."""
    shown: int
    """So many ticks are to be seen; of the rest words are wanted, for plans."""


def cuts(instruction: str, subgoals: Sequence[str], is_transition_T: NDArray[np.bool_]) -> list[Cut]:
    """All of them, the shortest first; none of an episode that does not count, or of one round only.

    ``subgoals``: T texts with foresight (`TrainingEpisode.with_foresight`).
    """
    if not (_BIN.search(instruction) or _SWINGS.search(instruction) or _REPEATS.search(instruction)):
        return []
    last = next((tick for tick, text in enumerate(subgoals) if _NO_MORE.search(text)), None)
    if last is None:
        return []
    begins: dict[tuple[str, str], int] = {}
    for tick, text in enumerate(subgoals[:last]):
        if (found := _ROUND.search(text)) is not None:
            begins.setdefault((found["nth"] or found["which"], found["color"] or ""), tick)
    after = next((tick for tick in range(last, len(subgoals)) if subgoals[tick] != subgoals[last]), len(subgoals))
    made = []
    for num_rounds, begin in enumerate(begins.values()):
        if num_rounds == 0:
            continue
        shown = min(begin + _MORE_TICKS, last)
        is_transition_U = np.concatenate([is_transition_T[:begin], np.arange(begin, shown) == begin])
        made.append(
            Cut(
                instruction=_asking_for(list(begins)[:num_rounds], instruction),
                ticks_U=np.concatenate([np.arange(shown), np.arange(after, len(subgoals))]),
                subgoals=(*subgoals[:begin], *[subgoals[last]] * (shown - begin), *subgoals[after:]),
                is_transition_U=np.concatenate([is_transition_U, is_transition_T[after:]]),
                end=begin,
                shown=shown,
            )
        )
    return made


def drawn_cut(made: Sequence[Cut], imitated_from: int, rng: np.random.Generator) -> Cut | None:
    """One way to end sooner, of those that leave something to imitate; None where there is none."""
    sooner = [each for each in made if each.end > imitated_from]
    return sooner[rng.integers(len(sooner))] if sooner else None


def _asking_for(rounds: Sequence[tuple[str, str]], instruction: str) -> str:
    """The instruction, as its task words it, for these rounds alone."""
    if (whole := _BIN.search(instruction)) is not None:
        counts = Counter(color for _, color in rounds)
        said = [color for _, color in _BINNED.findall(whole[0]) if counts[color]]
        return _BIN.sub(counted_cubes({color: counts[color] for color in said}), instruction)
    count = COUNTS[len(rounds) - 1]
    if len(rounds) == 1:
        return _REPEATS.sub("", _SWINGS.sub(r"put it down on the \1 target", instruction))
    for counted in (_SWINGS, _REPEATS):
        if (found := counted.search(instruction)) is not None:
            start, stop = found.span(found.lastindex or 0)
            return instruction[:start] + count + instruction[stop:]
    return instruction
