"""A PONDER's texts against the recorded ones: what counts as said rightly, and which places ask for memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.context import ContextFormat, Row, Transition
from dual_system.models.ponder.network import Ponder
from dual_system.training import words

SMALL = replace(tiny_cpu(), image_px=(32, 32), num_layers=4)


@pytest.fixture(scope="module")
def form() -> ContextFormat:
    return Ponder.random(SMALL, seed=1).format


def _row(form: ContextFormat, *texts: str) -> Row:
    v = form.vocabulary
    queries = [each for text in texts for each in form.query(1, Transition(subgoal=v.encode(text)))]
    return form.row([*form.opening("go"), *queries])


def _found(form: ContextFormat, row: Row, said: Row) -> words.Found:
    """What is found if each token is predicted to be the other row's, which has as many."""
    predicted = torch.from_numpy(np.asarray(said.targets)[row.supervised_index + 1])
    found = words.Found()
    found.add(row, 1e4 * torch.nn.functional.one_hot(predicted, SMALL.vocab_size), form.vocabulary)
    return found


def test_what_was_recorded_is_right(form: ContextFormat) -> None:
    row = _row(form, "pick [120, 340]", "put it down")
    found = _found(form, row, row)
    assert max(found.loss) == 0
    assert found.is_told_apart == [True] * 2
    assert (found.is_right, found.is_right_but_places, found.off) == ([True] * 2, [True] * 2, [0.0])


def test_a_place_that_was_read_before_is_not_asked_for_again(form: ContextFormat) -> None:
    row = _row(form, "seen at [120, 340]; pick [120, 340]", "pick [120, 340]", "pick [560, 340]")
    said = _row(form, "seen at [150, 380]; pick [120, 340]", "pick [120, 340]", "pick [560, 349]")
    found = _found(form, row, said)
    assert found.off == [50.0, 9.0]
    assert words._cells(found)[-1] == "50.0"  # 9 thousandths count as found, 50 do not
    assert found.is_right == [False, True, False]
    assert found.is_right_but_places == [True] * 3


def test_another_word_is_wrong_wherever_its_place_is(form: ContextFormat) -> None:
    found = _found(form, _row(form, "pick red [120, 340]"), _row(form, "pick bed [120, 340]"))
    assert (found.is_right, found.is_right_but_places, found.off) == ([False], [False], [0.0])
