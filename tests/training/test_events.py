"""Event-weighted sampling: what is near an event comes up more often, and nothing else about a draw changes."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock.sampling import ROBOMME
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from dual_system.training import recipes, train
from dual_system.training.events import EVENT_ROWS, draw_near, event_ticks
from dual_system.training.example import ExampleConfig, make_example
from dual_system.training.train import TrainOptions
from dual_system.training.training_episode import TrainingEpisode

ticks_of = st.lists(st.integers(0, 300), min_size=1, unique=True).map(sorted)


@given(ticks=ticks_of, events=ticks_of, weight=st.sampled_from([1.0, 3.0, 50.0]), data=st.data())
def test_a_draw_is_some_different_invocations_in_order(
    ticks: list[int], events: list[int], weight: float, data: st.DataObject
) -> None:
    count = data.draw(st.integers(0, len(ticks)))
    drawn = draw_near(ticks, np.array(events), count, weight, np.random.default_rng(0)).tolist()
    assert len(drawn) == count
    assert drawn == sorted(set(drawn))
    assert set(drawn) <= set(range(len(ticks)))


@given(ticks=ticks_of, events=ticks_of, seed=st.integers(0, 1000))
def test_weight_one_is_the_plain_choice(ticks: list[int], events: list[int], seed: int) -> None:
    """Runs that were made before there were weights can be made again."""
    plain = np.sort(np.random.default_rng(seed).choice(len(ticks), size=1 + len(ticks) // 2, replace=False))
    drawn = draw_near(ticks, np.array(events), len(plain), 1.0, np.random.default_rng(seed))
    np.testing.assert_array_equal(drawn, plain)


@pytest.mark.parametrize("weight", [0.5, 3.0])
def test_what_is_near_is_drawn_so_many_times_as_often(weight: float) -> None:
    ticks, event = list(range(0, 200, 5)), 100
    rng, drawn = np.random.default_rng(0), Counter[int]()
    for _ in range(40_000):
        drawn.update(draw_near(ticks, np.array([event]), 1, weight, rng).tolist())
    near = [drawn[i] for i, tick in enumerate(ticks) if event - EVENT_ROWS < tick <= event]
    far = [drawn[i] for i, tick in enumerate(ticks) if not event - EVENT_ROWS < tick <= event]
    assert len(near) == EVENT_ROWS // 5
    assert np.mean(near) / np.mean(far) == pytest.approx(weight, rel=0.1)


def test_events_are_transitions_and_turns_of_the_gripper() -> None:
    action_T8 = np.zeros((50, 8), np.float32)
    action_T8[:, 7] = -1.0
    action_T8[20:31, 7] = 1.0
    assert event_ticks(action_T8, {0, 20, 44}).tolist() == [0, 20, 31, 44]
    assert event_ticks(action_T8, ()).tolist() == [20, 31]


def test_without_an_event_all_are_as_likely() -> None:
    ticks = [3, 8, 13]
    nothing = np.empty(0, np.intp)
    assert draw_near(ticks, nothing, 3, 5.0, np.random.default_rng(0)).tolist() == [0, 1, 2]


def test_an_example_draws_its_invocations_so() -> None:
    num_ticks, grasp = 400, 300
    action_T8 = np.ones((num_ticks, 8), np.float32)
    action_T8[grasp:, 7] = -1.0
    picture = np.zeros((64, 64, 3), np.uint8)
    episode = TrainingEpisode(
        instruction="press it",
        demo=(),
        frames=[(picture, picture)] * num_ticks,
        state_T8=np.zeros((num_ticks, 8), np.float32),
        action_T8=action_T8,
        subgoals=["press"] * num_ticks,
        is_transition_T=np.arange(num_ticks) == 0,
    )
    form = Ponder.random(replace(tiny_cpu(), image_px=(64, 64), num_layers=4), seed=1).format
    config = ExampleConfig(clocks=ROBOMME, max_invocations=1, event_weight=1e6)
    rng = np.random.default_rng(0)
    for _ in range(20):
        (invocation,) = make_example(episode, form, config, rng).invocations
        assert invocation.tick == 0 or grasp - EVENT_ROWS < invocation.tick <= grasp
    with pytest.raises(ValueError, match="event_weight"):
        replace(config, event_weight=0.0)


@pytest.mark.parametrize(("given", "wanted"), [(None, 2.0), (3.0, 3.0)])
def test_the_command_line_comes_before_the_recipe(given: float | None, wanted: float) -> None:
    run = recipes.tiny()
    run = replace(run, example=replace(run.example, event_weight=2.0))
    options = TrainOptions(recipe="tiny", data=(Path("data"),), out=Path("out"), event_weight=given)
    assert train._adjusted(run, options).example == replace(run.example, event_weight=wanted)
