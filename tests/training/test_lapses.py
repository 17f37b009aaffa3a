"""Words that lapse: what is owed comes, nothing is said twice, and no error is learned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock.sampling import EVALUATION
from ponderpounce.models.context import IGNORE
from ponderpounce.models.ponder import Ponder
from ponderpounce.models.ponder_configs import tiny_cpu
from ponderpounce.training.example import ExampleConfig, TrainingEpisode, make_example
from ponderpounce.training.lapses import Lapses, Words, drawn_lapses, without_lapses

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
