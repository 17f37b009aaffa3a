"""A recorded PONDER's own words: they stand where they were said, what is owed comes, and no error is learned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock.sampling import EVALUATION
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.context import IGNORE
from dual_system.models.ponder.coordinates import normalised_text
from dual_system.models.ponder.network import Ponder
from dual_system.training.cut_short import cuts
from dual_system.training.example import ExampleConfig, make_example
from dual_system.training.lapses import without_lapses
from dual_system.training.own_words import as_recorded, own_words, speaks_of
from dual_system.training.training_episode import TrainingEpisode

FORM = Ponder.random(replace(tiny_cpu(), image_px=(32, 32), num_layers=4), seed=1).format
TEXTS = ["pick up the red cube at <40, 40>", "put it into the bin at <90, 90>", "press the button at <20, 160>"]
QUERIES = st.lists(
    st.tuples(st.sampled_from(TEXTS), st.booleans(), st.one_of(st.just(""), st.sampled_from(TEXTS))),
    min_size=1,
    max_size=25,
)


def as_columns(queries: list[tuple[str, bool, str]]) -> tuple[list[str], list[str], list[bool]]:
    """What was said, what is to be, and where it begins: at the first query, at every other text, and where drawn."""
    texts = [text for text, _, _ in queries]
    begins = [n == 0 or text != texts[n - 1] or again for n, (text, again, _) in enumerate(queries)]
    return [own for _, _, own in queries], texts, begins


@given(queries=QUERIES, seed=st.integers(0, 2**32 - 1), corrected=st.floats(0.05, 1.0))
def test_words_are_owed_until_they_are_said_and_only_they_are_learned(
    queries: list[tuple[str, bool, str]], seed: int, corrected: float
) -> None:
    said, texts, begins = as_columns(queries)
    words = own_words(said, texts, begins, np.random.default_rng(seed), corrected)
    last, is_anew = "", False
    for index, (own, text, each) in enumerate(zip(said, texts, words, strict=True)):
        is_anew |= index > 0 and begins[index] and text == texts[index - 1]
        assert each.is_due == (is_anew or last != text)
        assert each.text in ("", own, text)
        if each.text and each.is_learned:
            assert (each.text, each.is_due) == (text, True)
        if each.text and not each.is_learned:
            assert each.text == own
        if each.is_due and own == text:
            assert each.text == text, "who was right is not silenced"
            assert each.is_learned
        if each.text:
            last, is_anew = each.text, False
    assert words[0].text, "nothing is late at the first query"


@given(queries=QUERIES, seed=st.integers(0, 2**32 - 1))
def test_where_all_is_put_right_it_is_the_recording(queries: list[tuple[str, bool, str]], seed: int) -> None:
    said, texts, begins = as_columns(queries)
    words = own_words(said, texts, begins, np.random.default_rng(seed), 1.0)
    assert words == without_lapses(texts, begins)


@given(queries=QUERIES, seed=st.integers(0, 2**32 - 1))
def test_where_nothing_is_put_right_its_words_stand(queries: list[tuple[str, bool, str]], seed: int) -> None:
    said, texts, begins = as_columns(queries)
    said[0] = said[0] or texts[0]
    words = own_words(said, texts, begins, np.random.default_rng(seed), 0.0)
    assert [each.text for each in words] == said


def test_another_plan_is_owed_and_may_stand() -> None:
    text, own = f"{TEXTS[0]}, <60, 60>, <80, 20>", f"{TEXTS[0]}, <60, 60>"
    seen = set()
    for seed in range(20):
        (each,) = own_words([own], [text], [True], np.random.default_rng(seed), 0.5)
        assert each.is_due
        assert each.is_learned == (each.text == text)
        seen.add(each.text)
    assert seen == {own, text}


@pytest.mark.parametrize(
    ("said", "text", "is_same"),
    [
        ("pick up the cube at <40, 40>, <9, 9>", "pick up the cube at <44, 50>, <99, 99>, <7, 7>", True),
        ("pick up the cube at <40, 40>", "pick up the cube at <40, 60>", False),
        ("pick up the first cube at <40, 40>", "pick up the second cube at <40, 40>", False),
        ("press the button", "press the button", True),
        ("put it down, <40, 40>", "put it down", True),
        ("put it down", "put it down, <40, 40>, <80, 80>", True),
        ("put it down, <40, 40>", "put it down, <90, 90>", True),
        ("press the button", "press the button at <40, 40>", False),
        ("", "press the button", False),
    ],
)
def test_what_speaks_of_one_subgoal(said: str, text: str, is_same: bool) -> None:
    assert speaks_of(said, text) == is_same


def test_places_come_as_the_simulator_tells_them() -> None:
    assert as_recorded(normalised_text(TEXTS[0])) == TEXTS[0]
    assert as_recorded("put it at [1200, 30]") == "", "beside the picture: nothing to be read"


def recorded(said: dict[int, str], num_ticks: int = 200) -> TrainingEpisode:
    return TrainingEpisode(
        instruction="pick, put, press",
        demo=(),
        frames=[(np.zeros((32, 32, 3), np.uint8),) * 2] * num_ticks,
        state_T8=np.zeros((num_ticks, 8), np.float32),
        action_T8=np.zeros((num_ticks, 8), np.float32),
        subgoals=[TEXTS[tick * len(TEXTS) // num_ticks] for tick in range(num_ticks)],
        is_transition_T=np.isin(np.arange(num_ticks), [0, 67, 134]),
        said=[said.get(tick, "") for tick in range(num_ticks)],
        is_watched=True,
    )


@pytest.mark.parametrize("seed", range(4))
def test_a_row_holds_them_and_learns_what_puts_them_right(seed: int) -> None:
    config = ExampleConfig(clocks=EVALUATION, own_words=1.0)
    episode = recorded({0: TEXTS[0], 31: TEXTS[2], 120: TEXTS[0]})
    example = make_example(episode, FORM, config, np.random.default_rng(seed))
    assert example.words is not None
    row = example.row()
    learned = [id_ for id_ in row.targets if id_ != IGNORE]
    spelled = FORM.vocabulary.decode(learned)
    for each in example.words:
        assert not each.text or normalised_text(each.text) in FORM.vocabulary.decode(list(row.ids))
        if each.text and each.is_learned:
            assert normalised_text(each.text) in spelled
    assert normalised_text(TEXTS[0]) in spelled, "said when it was due"
    for text in TEXTS:  # as often as it is to be learned, and no error with it
        times = sum(each.text == text and each.is_learned for each in example.words)
        assert spelled.count(normalised_text(text)) == times
    assert len({each.text for each in example.words if each.text}) > 1


@pytest.mark.parametrize("offset", [0, 1])
def test_words_are_of_the_first_query_that_had_seen_their_tick(offset: int) -> None:
    config = ExampleConfig(clocks=EVALUATION, own_words=1.0)
    stood = set()
    for seed in range(20):
        silent = make_example(recorded({}), FORM, config, np.random.default_rng(seed))
        ticks = [query.tick for query in silent.schedule.queries]
        said = {0: TEXTS[0], ticks[2] + offset: TEXTS[2]}  # of a subgoal that is not due before the end
        example = make_example(recorded(said), FORM, config, np.random.default_rng(seed))
        assert [query.tick for query in example.schedule.queries] == ticks
        assert example.words is not None
        stood |= {n for n, each in enumerate(example.words) if each.text == TEXTS[2] and not each.is_learned}
    assert stood == {2 + offset}


def test_after_a_demonstration_the_first_words_are_right() -> None:
    """Others followed from what it had written about it, which no row holds."""
    config = ExampleConfig(clocks=EVALUATION, own_words=1.0)
    wrong = recorded({0: TEXTS[2]})
    shown = replace(wrong, demo=((np.zeros((32, 32, 3), np.uint8),) * 2,))
    first = set()
    for seed in range(20):
        for episode in (shown, wrong):
            example = make_example(episode, FORM, config, np.random.default_rng(seed))
            assert example.words is not None
            first.add((bool(episode.demo), example.words[0].text))
    assert first == {(True, TEXTS[0]), (False, TEXTS[0]), (False, TEXTS[2])}


def test_without_them_rows_are_as_before() -> None:
    config = ExampleConfig(clocks=EVALUATION)
    with_words, without = recorded({0: TEXTS[0], 31: TEXTS[2]}), recorded({})
    rows = [make_example(each, FORM, config, np.random.default_rng(3)).row() for each in (with_words, without)]
    assert rows[0].ids == rows[1].ids
    silent = replace(config, own_words=1.0)
    nobody = make_example(replace(without, said=()), FORM, silent, np.random.default_rng(3))
    assert nobody.row().ids == rows[1].ids


def test_of_an_episode_told_to_end_sooner_nothing_was_said() -> None:
    ends = [f"pick up the red cube at <40, 40> for the {n} time" for n in ("first", "second", "third")]
    texts = [text for text in (*ends, "press the button to finish at <20, 160>") for _ in range(50)]
    episode = replace(
        recorded({0: ends[0]}),
        instruction="pick up the red cube and place it on the target, repeating this action three times, then press",
        subgoals=texts,
        is_transition_T=np.arange(200) % 50 == 0,
    )
    (cut, *_) = cuts(episode.instruction, texts, episode.is_transition_T)
    assert episode.cut_short(cut).said == ()
