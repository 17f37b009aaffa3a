"""Words that lapse: what is owed comes, nothing is said twice, and no error is learned."""

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
from dual_system.training.example import ExampleConfig, make_example
from dual_system.training.lapses import NO_LAPSES, Lapses, Words, drawn_lapses, without_lapses
from dual_system.training.places import PLACE
from dual_system.training.training_episode import TrainingEpisode

FORM = Ponder.random(replace(tiny_cpu(), image_px=(32, 32), num_layers=4), seed=1).format
OFTEN = Lapses(rows=1.0, missed=0.5, wrong=0.3, longest=3)
STINTS = st.lists(st.tuples(st.sampled_from(["push", "pick", "put down"]), st.integers(1, 8)), min_size=1, max_size=6)


def told(stints: list[tuple[str, int]]) -> tuple[list[str], list[bool]]:
    """Subgoals of so many queries each, every one somewhere else."""
    texts = [f"{what} at <{40 * n}, 20>" for n, (what, length) in enumerate(stints) for _ in range(length)]
    return texts, [k == 0 for _, length in stints for k in range(length)]


@given(stints=STINTS, seed=st.integers(0, 2**32 - 1))
def test_what_is_due_is_what_was_said_last_and_is_not_so(stints: list[tuple[str, int]], seed: int) -> None:
    texts, is_change = told(stints)
    words = drawn_lapses(OFTEN, texts, is_change, np.random.default_rng(seed))
    assert len(words) == len(texts)
    last, waited = "", 0
    for index, (text, said) in enumerate(zip(texts, words, strict=True)):
        assert said.is_due == (last != text)
        if said.is_due:
            assert said.text in ("", text)
        else:
            assert said.text != text
            assert said.text in {"", *texts}
        waited = 0 if is_change[index] or said.text else waited + said.is_due
        assert waited < OFTEN.longest  # at the latest the next one puts it right, or a change makes it true
        last = said.text or last
    assert words[0] == Words(text=texts[0], is_due=True)


@given(stints=STINTS, seed=st.integers(0, 2**32 - 1))
def test_without_errors_it_is_the_recording(stints: list[tuple[str, int]], seed: int) -> None:
    texts, is_change = told(stints)
    never = Lapses(rows=1.0, missed=0.0, wrong=0.0)
    assert drawn_lapses(never, texts, is_change, np.random.default_rng(seed)) == without_lapses(texts, is_change)


def test_a_thing_that_was_pushed_is_no_other_thing() -> None:
    texts = ["pick at <100, 100>", "pick at <100, 100>", "pick at <106, 104>", "pick at <106, 104>"]
    words = drawn_lapses(replace(OFTEN, wrong=1.0), texts, [True, False, True, False], np.random.default_rng(0))
    assert all(said.is_due for said in words if said.text)


def recorded(changes: tuple[int, ...], num_ticks: int = 200) -> TrainingEpisode:
    count = np.cumsum([tick in changes for tick in range(num_ticks)])
    return TrainingEpisode(
        instruction="press the button, then pick",
        demo=(),
        frames=[(np.zeros((32, 32, 3), np.uint8),) * 2] * num_ticks,
        state_T8=np.zeros((num_ticks, 8), np.float32),
        action_T8=np.zeros((num_ticks, 8), np.float32),
        subgoals=[f"pick cube {n} at <{40 * n}, 20>" for n in count],
        is_transition_T=np.isin(np.arange(num_ticks), changes),
    )


@pytest.mark.parametrize("seed", range(6))
def test_no_error_is_learned_and_what_should_have_been_is(seed: int) -> None:
    config = ExampleConfig(clocks=EVALUATION, lapses=OFTEN)
    example = make_example(recorded((0, 60, 120)), FORM, config, np.random.default_rng(seed))
    assert example.words is not None
    assert any(said.is_due != bool(said.text) for said in example.words)
    row, v = example.row(), FORM.vocabulary
    place = 0
    for number, said in enumerate(example.words):
        place = row.ids.index(v.vision_end, row.ids.index(v.vision_end, place) + 1) + 1  # two views
        label = row.targets[place]
        assert label == (v.t_yes if said.is_due else v.t_no)
        carrier = int(row.carrier_index[number, 0])
        if said.text:
            assert row.ids[place] == v.t_yes
            learned = [row.targets[i] for i in range(place + 1, carrier)]
            assert learned == (list(row.ids[place + 1 : carrier]) if said.is_due else [IGNORE] * (carrier - place - 1))
            assert row.targets[carrier] == v.t_no
        else:
            assert carrier == place
        place = carrier


def test_the_target_of_cognition_does_not_lapse() -> None:
    episode, config = recorded((0, 60, 120)), ExampleConfig(clocks=EVALUATION)
    right, erring = (
        make_example(episode, FORM, each, np.random.default_rng(3)) for each in (config, replace(config, lapses=OFTEN))
    )
    assert erring.words is not None
    assert right.words is None
    assert right.schedule == erring.schedule
    assert np.array_equal(right.stand_ins(64), erring.stand_ins(64))


def test_shares_are_shares() -> None:
    with pytest.raises(ValueError, match="missed must be in"):
        Lapses(missed=1.5)
    with pytest.raises(ValueError, match="longest must be at least 1"):
        Lapses(longest=0)


PATHS = st.lists(st.tuples(st.integers(0, 255), st.integers(0, 255)), min_size=1, max_size=20)


@given(path=PATHS, by_px=st.floats(0.5, 50.0))
def test_told_again_words_are_never_farther_off_than_allowed(path: list[tuple[int, int]], by_px: float) -> None:
    texts = [f"pick at <{y}, {x}>, <9, 9>" for y, x in path]
    words = drawn_lapses(NO_LAPSES, texts, [k == 0 for k in range(len(path))], np.random.default_rng(0), by_px)
    last = (-1e3, -1e3)
    for place, text, said in zip(path, texts, words, strict=True):
        off_px = np.hypot(place[0] - last[0], place[1] - last[1])
        assert said == (Words(text=text, is_due=True) if off_px > by_px else Words())
        last = place if said.text else last


@given(stints=STINTS, seed=st.integers(0, 2**32 - 1))
def test_a_slip_is_not_learned_and_is_put_right(stints: list[tuple[str, int]], seed: int) -> None:
    texts, is_change = told(stints)
    slipping = Lapses(rows=1.0, missed=0.3, wrong=0.0, slipped=0.5, slip_px=(20.0, 40.0))
    words = drawn_lapses(slipping, texts, is_change, np.random.default_rng(seed), 4.0)
    last = ""
    for index, (text, said) in enumerate(zip(texts, words, strict=True)):
        if said.text:
            assert said.is_due
            assert said.is_learned == (said.text == text)
        far = bool(last) and far_px(last, text) > 4.0
        assert said.is_due == (is_change[index] or far or is_owed(words, index))
        last = said.text or last


@given(stints=STINTS, seed=st.integers(0, 2**32 - 1))
def test_a_place_told_elsewhere_is_not_learned_and_is_put_right(stints: list[tuple[str, int]], seed: int) -> None:
    texts, is_change = told(stints)
    plans = [*texts[1:], texts[0]]  # each tells a place of the plan besides
    texts = [text + plan[plan.index(" at ") :].replace(" at", ",") for text, plan in zip(texts, plans, strict=True)]
    astray = Lapses(rows=1.0, missed=0.0, wrong=0.0, elsewhere=0.6)
    words = drawn_lapses(astray, texts, is_change, np.random.default_rng(seed))
    last, waited = "", 0
    for text, changes, said in zip(texts, is_change, words, strict=True):
        is_wrong = bool(last) and far_px(last, text) > 16.0
        assert said.is_due >= is_wrong
        assert said.is_due <= (changes or is_wrong)  # a change may make true what was wrong
        assert said.is_learned == (said.text in ("", text))
        if said.text:
            assert PLACE.sub("", said.text) == PLACE.sub("", text)
            there = {place[n] for each in texts for place in PLACE.findall(each) for n in (0, 1)}
            assert all({*place} <= there for place in PLACE.findall(said.text))
        waited = 0 if changes or said.text else waited + said.is_due
        assert waited < astray.longest
        last = said.text or last


def test_about_as_many_places_are_told_elsewhere_as_asked_for() -> None:
    texts = [f"pick at <{n}, {x}>, <{m}, 20>" for n, m, x in ((20, 80, 20), (80, 140, 60), (140, 20, 90))]
    astray = Lapses(rows=1.0, missed=0.0, wrong=0.0, elsewhere=0.5, longest=1)
    rng = np.random.default_rng(0)
    firsts = [drawn_lapses(astray, texts, [True] * 3, rng)[1] for _ in range(400)]
    assert 0.4 < np.mean([not said.is_learned for said in firsts]) < 0.6
    own = np.mean([far_px(said.text, texts[1]) > 0 for said in firsts])
    assert 0.3 < own < 0.45  # three of four of these, the others in the plan


def far_px(one: str, other: str) -> float:
    first, second = (np.array([int(v) for v in PLACE.findall(text)[0]]) for text in (one, other))
    return float(np.hypot(*(first - second)))


def is_owed(words: tuple[Words, ...], index: int) -> bool:
    """Whether the query before was due and stayed silent."""
    return index > 0 and words[index - 1].is_due and not words[index - 1].text


def test_a_slip_moves_only_the_own_place() -> None:
    slipping = Lapses(rows=1.0, missed=0.0, wrong=0.0, slipped=1.0, slip_px=(20.0, 20.0))
    (said,) = drawn_lapses(slipping, ["pick at <100, 100>, <50, 60>"], [True], np.random.default_rng(0))
    assert said.text.endswith(", <50, 60>")
    assert far_px(said.text, "<100, 100>") > 4.0
    assert not said.is_learned


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_a_row_is_told_again_where_a_slip_is_due(seed: int) -> None:
    slipping = Lapses(rows=1.0, missed=0.0, wrong=0.0, slipped=0.9, slip_px=(20.0, 40.0))
    config = ExampleConfig(clocks=EVALUATION, lapses=slipping, retold_px=4.0)
    example = make_example(recorded((0, 60, 120)), FORM, config, np.random.default_rng(seed))
    assert example.words is not None
    assert sum(bool(said.text) for said in example.words) > 3
    assert example.said[-1] == normalised_text([said.text for said in example.words if said.text][-1])
    row = example.row()
    t_yes = FORM.vocabulary.t_yes
    begins = [index for index, label in enumerate(row.targets) if label == t_yes]
    for begin, said in zip(begins, (said for said in example.words if said.text), strict=True):
        assert row.ids[begin] == t_yes
        assert (row.targets[begin + 1] != IGNORE) == said.is_learned


def test_rows_that_slip_whole_cannot_be_told_again() -> None:
    with pytest.raises(ValueError, match="never puts them right"):
        ExampleConfig(clocks=EVALUATION, slips=0.4, retold_px=4.0)
