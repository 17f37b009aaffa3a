"""Waits: counted to the tick at which something else is asked, and told by any query as of its own instant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from clock.sampling import EVALUATION, ROBOMME
from dual_system.models.place_code import NUM_PLACE_FEATURES, place_features
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.context import IGNORE
from dual_system.models.ponder.coordinates import normalised_text
from dual_system.models.ponder.network import Ponder
from dual_system.tasks.captions import ORDINALS
from dual_system.tasks.counting.stop_cube import StopCube
from dual_system.training.countdown import (
    as_place,
    counted,
    misjudged,
    rhythm,
    stood_at,
    waiting_longer,
    waits,
    waits_unplaced,
)
from dual_system.training.example import ExampleConfig, make_example
from dual_system.training.lapses import Words
from dual_system.training.nudge import Nudge
from dual_system.training.stand_in import stand_in
from dual_system.training.training_episode import TrainingEpisode

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


@given(first=st.integers(0, 60), count=st.integers(0, 14), every=st.integers(15, 25), rest=st.integers(0, 40))
def test_a_misjudged_wait_is_that_of_another_rhythm_and_is_put_right(
    first: int, count: int, every: int, rest: int
) -> None:
    ticks = [0, *(first + every * n for n in range(1, count + 1)), first + every * (count + 1) + rest]
    due = ticks[-1]
    texts = [HOVER, *[STILL] * count, PRESS]
    left = [due, *(due - tick for tick in ticks[1:-1]), None]
    seen = set()
    for seed in range(30):
        wrong = misjudged(ticks, texts, left, np.random.default_rng(seed))
        assert wrong[0] is None, "where a place is told no number is"
        assert wrong[-1] is None
        at = [n for n, each in enumerate(wrong) if each is not None]
        assert at == [*range(1, len(at) + 1)], "the first ones"
        assert bool(at) == bool(count)
        told = [each + ticks[n] for n, each in enumerate(wrong) if each is not None]
        assert len(set(told)) <= 1, "one instant, the same at every query"
        assert all(each >= 0 for each in wrong if each is not None)
        assert due not in told or due < 3
        seen.add(len(at))
    assert count < 2 or len(seen) > 1


def test_a_misjudged_wait_is_not_learned_and_c_knows_better() -> None:
    recorded = waiting_episode([HOVER] * 40 + [STILL] * 200 + [PRESS] * 30, (0, 40, 240))
    config = ExampleConfig(clocks=EVALUATION, counts_down=True)
    right, wrong = (
        make_example(recorded, FORM, replace(config, misjudges=share), np.random.default_rng(5)) for share in (0.0, 1.0)
    )
    assert right.words is not None
    assert wrong.words is not None
    assert [each.is_due for each in wrong.words] == [each.is_due for each in right.words]
    others = [new for old, new in zip(right.words, wrong.words, strict=True) if old != new]
    assert others
    assert not any(each.is_learned for each in others)
    assert all(each.text.startswith(STILL) for each in others)
    np.testing.assert_array_equal(right.stand_ins(128), wrong.stand_ins(128))
    config = replace(config, misjudges=1.0, trusts_counts=True)
    trusting = make_example(recorded, FORM, config, np.random.default_rng(5))
    assert trusting.words == wrong.words
    is_other = [old != new for old, new in zip(right.words, wrong.words, strict=True)]
    tells_other = (trusting.stand_ins(128) != right.stand_ins(128)).any(dim=1).tolist()
    assert tells_other == is_other, "unless it trusts them"
    learned = FORM.vocabulary.decode([id_ for id_ in wrong.row().targets if id_ != IGNORE])
    assert learned.count(STILL) == sum(each.text.startswith(STILL) for each in wrong.words) - len(others)


@given(hover=st.integers(0, 40), still=st.integers(1, 300), press=st.integers(1, 30), longer=st.integers(0, 12))
def test_a_wait_told_longer_ends_so_much_later_or_with_the_episode(
    hover: int, still: int, press: int, longer: int
) -> None:
    texts = [HOVER] * hover + [STILL] * still + [PRESS] * press
    begins_T = np.isin(np.arange(len(texts)), [0, hover, hover + still])
    told, told_begins_T = waiting_longer(texts, begins_T, longer)
    more = min(longer, press - 1)
    assert told == [HOVER] * hover + [STILL] * (still + more) + [PRESS] * (press - more)
    assert np.flatnonzero(told_begins_T).tolist() == sorted({0, hover, hover + still + more})
    assert waiting_longer(told, told_begins_T, 0)[0] == told
    assert waits(told)[0] == hover + still + more


def test_who_never_waits_is_told_as_ever() -> None:
    texts, begins_T = ["pick it up"] * 3, np.array([True, False, False])
    assert waiting_longer(texts, begins_T, 5)[0] == texts
    assert waiting_longer([STILL] * 3, begins_T, 5)[0] == [STILL] * 3, "it never ends"


def test_c_and_words_are_told_the_longer_wait() -> None:
    recorded = waiting_episode([HOVER] * 40 + [STILL] * 100 + [PRESS] * 30, (0, 40, 140))
    config = ExampleConfig(clocks=EVALUATION, counts_down=True, waits_longer=5)
    example = make_example(recorded, FORM, config, np.random.default_rng(0))
    assert example.words is not None
    at = next(n for n, query in enumerate(example.schedule.queries) if query.tick >= 60)
    wait = 145 - example.schedule.queries[at].tick
    assert example.words[at].text == f"{STILL} {wait}"
    np.testing.assert_array_equal(example.stand_ins(128)[at][:NUM_PLACE_FEATURES], place_features((0, wait)))


def test_the_rhythm_is_that_of_the_scene() -> None:
    for seed in range(40):
        layout = StopCube().sample(np.random.default_rng(seed), "easy")
        texts = [HOVER] * 30 + [STILL] * (layout.press_step - 30) + [PRESS] * 30
        assert rhythm(StopCube().instruction(layout), texts) == layout.pass_steps
    assert rhythm("pick it up", texts) is None
    assert rhythm(StopCube().instruction(layout), [HOVER] * 30) is None, "it is never stopped"


def test_the_rhythm_is_a_lesson_once_it_has_been_seen() -> None:
    asked = f"press the button to stop the cube just as it reaches the target for the {ORDINALS[2]} time"
    texts = [HOVER] * 30 + [STILL] * 240 + [PRESS] * 30  # stopped after 300, in the third pass: 120 each
    recorded = replace(waiting_episode(texts, (0, 30, 270)), instruction=asked)
    example = make_example(recorded, FORM, ExampleConfig(clocks=EVALUATION), np.random.default_rng(0))
    row = example.row()
    lessons = example.place_lessons(row, 4 * NUM_PLACE_FEATURES)
    at = lessons.index_M[lessons.first_M == 3 * NUM_PLACE_FEATURES].tolist()
    seen = [query.tick >= 60 for query in example.schedule.queries]
    assert at == [index for index, is_seen in zip(row.gate_index.tolist(), seen, strict=True) if is_seen]
    assert 0 < len(at) < len(seen)
    codes = lessons.features_MP[lessons.first_M == 3 * NUM_PLACE_FEATURES]
    assert (codes == codes[0]).all()
    texts = [HOVER] * 30 + [STILL] * 60 + [PRESS] * 30  # stopped after 120, in the second pass: 80 each
    faster = replace(waiting_episode(texts, (0, 30, 90)), instruction=asked.replace("third", "second"))
    other = make_example(faster, FORM, ExampleConfig(clocks=EVALUATION), np.random.default_rng(0))
    again = other.place_lessons(other.row(), 4 * NUM_PLACE_FEATURES)
    assert not (again.features_MP[again.first_M == 3 * NUM_PLACE_FEATURES][0] == codes[0]).all()
