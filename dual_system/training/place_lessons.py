"""Places that PONDER is to have in mind where it is about to speak: lessons of the auxiliary loss w4.

A place is said once in a subgoal, in some eight tokens, and cross-entropy over digits tells little of which of the
things that were lit is meant. Cognition, asked for one place at every query and as numbers, learned the same much
faster. So hidden states are asked for places in that form (`place_features`) where words come from:

- at the end of every observation, for all places that the words in force name, one after the other in the first
  numbers: what is to be said, and later read, whether or not it is said now;
- at every token before one of a coordinate's, for the place that is being told;
- at the end of every observation, for the rhythm in which something comes by (`countdown.rhythm`), and at every token
  before one of its number's, or of the number of steps that are left (`notes`), for that.

- at the end of every picture of a demonstration, for what is being done (`deeds`): where, where the deed before was,
  and codes of which it is and for which time. What was done second is asked for once, a minute later; nothing else
  teaches a network to notice it when it is seen. Where a way is shown, at the last of its image tokens, too, for where
  the tool is: on which side of a thing it passes is seen on the way alone.

Only networks from scratch need it; the paper has nothing of it. Nothing reads these numbers in serving.
"""

# Q queries, M lessons of a row, P numbers that tell a place

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dual_system.models.place_code import NUM_PLACE_FEATURES, place_features
from dual_system.models.ponder.context import IGNORE, Row
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.training.countdown import LONGEST
from dual_system.training.deeds import deeds, passing_side
from dual_system.training.places import PLACE, TEXT_PX, WAY
from dual_system.training.stand_in import text_code

_Lesson = tuple[int, int, NDArray[np.float32]]
"""Position in the row, slot, the P numbers that should be there."""

_TOLD = re.compile(r"\[(\d+), (\d+)\]")  # x, y in thousandths
_PACED = re.compile(r"(?<=[\]a-z]), (\d+), (\d+)")  # the rhythm, and the steps that are left
_FULL = 1000


class PlaceLessons(NamedTuple):
    """Which numbers of which hidden states of a row should tell which place."""

    index_M: Tensor
    """int64: positions in the row."""
    first_M: Tensor
    """int64: the first of the P numbers."""
    features_MP: Tensor

    def answers(self, hidden_TH: Tensor) -> Tensor:
        """What is there, (M, P)."""
        columns_MP = self.first_M[:, None] + torch.arange(NUM_PLACE_FEATURES, device=hidden_TH.device)
        return hidden_TH[self.index_M[:, None], columns_MP]

    def to(self, device: torch.device | str) -> PlaceLessons:
        return PlaceLessons(*(each.to(device) for each in self))


def place_lessons(
    row: Row,
    texts_Q: Sequence[str],
    vocabulary: Vocabulary,
    size: int,
    demonstrated: Sequence[str] = (),
    tools: Sequence[str] = (),
    rhythms_Q: Sequence[int | None] = (),
) -> PlaceLessons:
    """The lessons of a row with hidden states of ``size`` numbers.

    ``texts_Q``: the simulator's words in force at every query; ``demonstrated``: those of every instant of the
    demonstration, ``tools``: where the tool is then; ``rhythms_Q``: every how many steps something comes by, None
    before that was to be seen. Of more places than fit the last are left out.
    """
    num_slots = size // NUM_PLACE_FEATURES
    found = [
        *_seen_done(row, demonstrated, vocabulary, num_slots),
        *_seen_going(row, demonstrated, tools, vocabulary, num_slots),
        *_in_mind(row, texts_Q, num_slots),
        *_coming_by(row, rhythms_Q, num_slots),
        *_being_told(row, vocabulary, num_slots),
    ]
    features = [numbers for _, _, numbers in found]
    return PlaceLessons(
        index_M=torch.tensor([index for index, _, _ in found], dtype=torch.int64),
        first_M=torch.tensor([slot * NUM_PLACE_FEATURES for _, slot, _ in found], dtype=torch.int64),
        features_MP=torch.from_numpy(np.array(features, np.float32).reshape(-1, NUM_PLACE_FEATURES)),
    )


def _seen_done(row: Row, texts: Sequence[str], vocabulary: Vocabulary, num_slots: int) -> Iterator[_Lesson]:
    """Slot 0: where it is done, 1: its `place_before`, 2: which it is, and how often by now, 3: its number."""
    for index, deed in zip(_picture_ends(row, len(texts), vocabulary), deeds(texts), strict=False):
        places = [None if place is None else place_features(place) for place in (deed.place, deed.place_before)]
        codes = [text_code(name, NUM_PLACE_FEATURES) for name in (f"{deed.name} {deed.count}", f"deed {deed.number}")]
        for slot, numbers in enumerate([*places, *codes][:num_slots]):
            if numbers is not None:
                yield index, slot, numbers


def _seen_going(
    row: Row, texts: Sequence[str], tools: Sequence[str], vocabulary: Vocabulary, num_slots: int
) -> Iterator[_Lesson]:
    """Slot 0: where the tool is, 1: on which side of the thing that it is led around this stretch passes."""
    for index, text, tool in zip(_picture_ends(row, len(texts), vocabulary), texts, tools, strict=False):
        place = PLACE.search(tool)
        if WAY.search(text) is not None and place is not None:
            yield index - 1, 0, place_features((int(place[1]), int(place[2])))
            if (side := passing_side(text)) and num_slots > 1:
                yield index - 1, 1, text_code(side, NUM_PLACE_FEATURES)


def _picture_ends(row: Row, num_instants: int, vocabulary: Vocabulary) -> list[int]:
    """Where the last picture of every instant of a demonstration ends, and further ones."""
    ends = np.flatnonzero(np.asarray(row.ids) == vocabulary.vision_end)
    per_instant = np.count_nonzero(ends <= row.gate_index[0]) // (num_instants + 1)  # the first query's among them
    found: list[int] = ends[per_instant - 1 :: per_instant].tolist()
    return found


def _in_mind(row: Row, texts_Q: Sequence[str], num_slots: int) -> Iterator[_Lesson]:
    for index, text in zip(row.gate_index.tolist(), texts_Q, strict=True):
        for slot, (y, x) in enumerate(PLACE.findall(text)[:num_slots]):
            yield index, slot, place_features((int(y), int(x)))


def _coming_by(row: Row, rhythms_Q: Sequence[int | None], num_slots: int) -> Iterator[_Lesson]:
    for index, steps in zip(row.gate_index.tolist(), rhythms_Q, strict=False):
        if steps is not None:
            yield from _rhythm(index, steps, num_slots)


def _rhythm(index: int, steps: int, num_slots: int) -> Iterator[_Lesson]:
    """The last slot, where there is more than one."""
    if num_slots > 1:
        yield index, num_slots - 1, text_code(f"comes by every {steps} steps", NUM_PLACE_FEATURES)


def _being_told(row: Row, vocabulary: Vocabulary, num_slots: int) -> Iterator[_Lesson]:
    """Of the words that are learned: what slipped is not to be kept in mind."""
    positions = np.flatnonzero(np.asarray(row.targets) != IGNORE)
    pieces = {id_: vocabulary.decode([id_]) for id_ in {row.targets[position] for position in positions}}
    for run in np.split(positions, np.flatnonzero(np.diff(positions) > 1) + 1):
        spelled = [pieces[row.targets[position]] for position in run]
        begins = np.cumsum([0, *map(len, spelled)])[:-1]
        said = "".join(spelled)
        for told in _TOLD.finditer(said):
            x, y = (int(value) * TEXT_PX / _FULL for value in told.groups())
            for position in run[(begins >= told.start(1)) & (begins < told.end(2))].tolist():
                yield position - 1, 0, place_features((y, x))
        for told in _PACED.finditer(said):
            for position in run[(begins >= told.start(1)) & (begins < told.end(1))].tolist():
                yield from _rhythm(position - 1, int(told[1]), num_slots)
            for position in run[(begins >= told.start(2)) & (begins < told.end(2))].tolist():
                wait = int(told[2])  # as cognition tells it, and coarsely, for longer ones
                yield position - 1, 0, place_features((min(wait / 4, LONGEST), min(wait, LONGEST)))
