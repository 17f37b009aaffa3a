"""Waits: counted to the tick at which something else is asked, and told by any query as of its own instant."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ponderpounce.models.place_code import NUM_PLACE_FEATURES, place_features
from ponderpounce.training.countdown import counting_down, waits
from ponderpounce.training.stand_in import skill_of, stand_in

HOVER, STILL, PRESS = (
    "move to the top of the button at <60, 90> to prepare",
    "remain static",
    "press the button to stop",
)


@given(hover=st.integers(0, 40), still=st.integers(0, 300), press=st.integers(0, 30))
def test_a_wait_ends_where_it_no_longer_waits(hover: int, still: int, press: int) -> None:
    found = waits([HOVER] * hover + [STILL] * still + [PRESS] * press)
    waiting = hover + still
    assert found[:waiting] == (list(range(waiting, 0, -1)) if press else [None] * waiting)
    assert found[waiting:] == [None] * press


def test_texts_that_do_not_wait_are_left() -> None:
    assert waits(["pick it up", "place it"]) == [None, None]
    assert counting_down(PRESS, None) == PRESS


@given(wait=st.integers(1, 600))
def test_a_stand_in_tells_the_wait(wait: int) -> None:
    """Where nothing else is told as the place itself; beside the place where the tool is to be all the same."""
    still, hover = (stand_in(counting_down(text, wait), 128) for text in (STILL, HOVER))
    np.testing.assert_array_equal(still[:NUM_PLACE_FEATURES], place_features((0, min(wait, 255))))
    np.testing.assert_array_equal(hover[:NUM_PLACE_FEATURES], place_features((60, 90)))
    sooner = stand_in(counting_down(HOVER, max(1, wait - 1)), 128)
    assert np.array_equal(sooner, hover) == (wait == 1 or wait > 255)
    assert skill_of(counting_down(STILL, wait)) == skill_of(counting_down(STILL, 1))
