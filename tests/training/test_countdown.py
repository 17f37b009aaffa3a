"""Waits: counted to the tick at which something else is asked, and told by any query as of its own instant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from clock.sampling import EVALUATION, ROBOMME
from ponderpounce.models.place_code import NUM_PLACE_FEATURES, place_features
from ponderpounce.models.ponder import Ponder
from ponderpounce.models.ponder_configs import tiny_cpu
from ponderpounce.models.ponder_coordinates import normalised_text
from ponderpounce.training.countdown import as_place, counted, stood_at, waits, waits_unplaced
from ponderpounce.training.example import ExampleConfig, make_example
from ponderpounce.training.lapses import Words
from ponderpounce.training.nudge import Nudge
from ponderpounce.training.stand_in import stand_in
from ponderpounce.training.training_episode import TrainingEpisode

HOVER, STILL, PRESS = (
    "move to the top of the button at <60, 90> to prepare",
    "remain static",
    "press the button to stop the cube on the target at <20, 30>",
)


@given(hover=st.integers(0, 40), still=st.integers(0, 300), press=st.integers(0, 30))
def test_a_wait_ends_where_it_no_longer_waits(hover: int, still: int, press: int) -> None:
    found = waits([HOVER] * hover + [STILL] * still + [PRESS] * press)
    waiting = hover + still
    assert found[:waiting] == (list(range(waiting, 0, -1)) if press else [None] * waiting)
    assert found[waiting:] == [None] * press


def test_texts_that_do_not_wait_are_left() -> None:
    assert waits(["pick it up", "place it"]) == [None, None]


FORM = Ponder.random(replace(tiny_cpu(), image_px=(32, 32), num_layers=4), seed=1).format


def waiting_episode(texts: list[str], changes: tuple[int, ...]) -> TrainingEpisode:
    num_ticks = len(texts)
    return TrainingEpisode(
        instruction="stop it",
        demo=(),
        frames=[(np.zeros((32, 32, 3), np.uint8),) * 2] * num_ticks,
        state_T8=np.zeros((num_ticks, 8), np.float32),
        action_T8=np.zeros((num_ticks, 8), np.float32),
        subgoals=texts,
        is_transition_T=np.isin(np.arange(num_ticks), changes),
    )


def test_every_query_is_told_its_own_wait() -> None:
    """Where nothing else is told as the place itself; beside the place where the tool is to be all the same."""
    texts = [HOVER] * 40 + [STILL] * 300 + [PRESS] * 30
    recorded = waiting_episode(texts, (0, 40, 340))
    config = ExampleConfig(clocks=EVALUATION, tells_onward=1.0)  # the text after the wait names a place, too
    example = make_example(recorded, FORM, config, np.random.default_rng(0))
    made = example.stand_ins(128).numpy()
    for query, vector in zip(example.schedule.queries, made, strict=True):
        wait = 340 - query.tick
        place = vector[:NUM_PLACE_FEATURES]
        if texts[query.tick] == STILL:
            np.testing.assert_array_equal(place, place_features((0, min(wait, 255))))
            told = f"{STILL} until {as_place(wait)}"
            np.testing.assert_array_equal(vector, stand_in(told, 128, onward="<60, 90>"))
        elif texts[query.tick] == HOVER:
            np.testing.assert_array_equal(place, place_features((60, 90)))
            np.testing.assert_array_equal(vector, stand_in(HOVER, 128, onward=as_place(wait)))
        else:
            np.testing.assert_array_equal(vector, stand_in(PRESS, 128, onward="<60, 90>"))


def test_a_hand_is_told_where_it_waits_as_long_as_it_does() -> None:
    assert stood_at(["pick it up at <1, 1>", HOVER, STILL, PRESS]) == ["", "<60, 90>", "<60, 90>", "<60, 90>"]
    assert stood_at([STILL, PRESS]) == ["", ""]


@given(left=st.lists(st.one_of(st.none(), st.integers(0, 500)), max_size=12), seed=st.integers(0, 9))
def test_a_wait_is_counted_down_at_every_query(left: list[int | None], seed: int) -> None:
    """But where a place is on its way to be said, and where nothing is waited for."""
    rng = np.random.default_rng(seed)
    subgoals = [str(rng.choice([HOVER, STILL, PRESS])) for _ in left]
    words = [Words(text=text, is_due=True) if rng.random() < 0.5 else Words() for text in subgoals]
    for old, new, text, wait in zip(words, counted(words, subgoals, left), subgoals, left, strict=True):
        if text == STILL and wait is not None:
            assert new == Words(text=f"remain static {wait}", is_due=True)
        elif text == HOVER or wait is None:
            assert new == old


def test_a_start_that_nothing_leads_back_from_is_not_moved_aside() -> None:
    texts = [HOVER] * 40 + [STILL] * 120 + [PRESS] * 30
    assert waits_unplaced(texts) == [False] * 40 + [True] * 150
    assert waits_unplaced(["pick it up at <1, 1>", "put it down"]) == [False, False]
    config = ExampleConfig(clocks=ROBOMME, max_invocations=1 << 30, nudge=Nudge(std_m=0.04, return_rows=8))
    example = make_example(waiting_episode(texts, (0, 40, 160)), FORM, config, np.random.default_rng(0))
    assert example.nudges_I2 is not None
    for invocation, nudge_2 in zip(example.invocations, example.nudges_I2, strict=True):
        assert np.any(nudge_2) == (texts[invocation.tick] == HOVER)


def test_a_row_says_its_counts() -> None:
    texts = [HOVER] * 40 + [STILL] * 120 + [PRESS] * 30
    recorded = waiting_episode(texts, (0, 40, 160))
    example = make_example(recorded, FORM, ExampleConfig(clocks=EVALUATION, counts_down=True), np.random.default_rng(0))
    for query, said in zip(example.schedule.queries, example.said, strict=True):
        if texts[query.tick] == STILL:
            assert said == f"remain static {160 - query.tick}"
    assert example.said[-1] == normalised_text(PRESS)


def test_the_longest_wait_is_as_long_as_a_picture_is_wide() -> None:
    assert [as_place(wait) for wait in (1, 255, 256, 900)] == ["<0, 1>", *["<0, 255>"] * 3]
