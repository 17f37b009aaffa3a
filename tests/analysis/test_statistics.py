"""Rates and intervals: laws over any outcomes, coverage on a case whose truth is known, and a few values by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.analysis.statistics import bootstrap, paired, sign_test, success_rate, wilson

FEW = 200  # resamples: laws hold for any number


@st.composite
def suites(draw: st.DrawFn, num_runs: int | None = None) -> list[np.ndarray]:
    """Outcomes of one to three tasks."""
    runs = num_runs or draw(st.integers(1, 3))
    sizes = draw(st.lists(st.integers(1, 7), min_size=1, max_size=3))
    bits = [draw(st.lists(st.integers(0, 1), min_size=runs * size, max_size=runs * size)) for size in sizes]
    return [np.reshape(bit, (runs, size)) for bit, size in zip(bits, sizes, strict=True)]


@given(suites(), st.randoms(use_true_random=False))
def test_the_order_of_scenes_changes_nothing(tasks: list[np.ndarray], random: Any) -> None:
    orders = [random.sample(range(task.shape[1]), task.shape[1]) for task in tasks]
    shuffled = [task[:, order] for task, order in zip(tasks, orders, strict=True)]
    assert bootstrap(shuffled, num_resamples=FEW) == bootstrap(tasks, num_resamples=FEW)


@given(suites(), st.integers(0, 100))
def test_an_interval_lies_within_zero_and_one_and_is_the_same_for_one_seed(tasks: list[np.ndarray], seed: int) -> None:
    interval = bootstrap(tasks, num_resamples=FEW, seed=seed)
    assert -1e-9 <= interval.low <= interval.high <= 1 + 1e-9
    assert interval.value == success_rate(tasks)
    assert interval == bootstrap(tasks, num_resamples=FEW, seed=seed)


@given(suites(), st.data())
def test_one_more_success_never_lowers_a_rate(tasks: list[np.ndarray], data: st.DataObject) -> None:
    which = data.draw(st.integers(0, len(tasks) - 1))
    cell = tuple(data.draw(st.integers(0, size - 1)) for size in tasks[which].shape)
    better = [task.copy() for task in tasks]
    better[which][cell] = 1
    assert success_rate(better) >= success_rate(tasks)
    assert paired(tasks, better, num_resamples=FEW).num_worse == 0


@given(st.integers(1, 200), st.data())
def test_wilson_grows_with_the_successes_and_shrinks_with_the_trials(trials: int, data: st.DataObject) -> None:
    successes = data.draw(st.integers(0, trials - 1))
    here, next_ = wilson(successes / trials, trials), wilson((successes + 1) / trials, trials)
    assert here.low <= next_.low
    assert here.high <= next_.high
    many = wilson(successes / trials, 4 * trials)
    assert many.high - many.low < here.high - here.low
    mirrored = wilson(1 - successes / trials, trials)
    assert math.isclose(mirrored.high, 1 - here.low, abs_tol=1e-9)
    assert 0 <= here.low <= here.value <= here.high <= 1


@given(suites(num_runs=2), st.integers(1, 3), st.data())
def test_the_difference_turned_round_is_the_other_way_round(
    tasks: list[np.ndarray], num_runs: int, data: st.DataObject
) -> None:
    others = [
        np.reshape(data.draw(st.lists(st.integers(0, 1), min_size=n, max_size=n)), (num_runs, task.shape[1]))
        for task in tasks
        for n in [num_runs * task.shape[1]]
    ]
    there, back = paired(tasks, others, num_resamples=FEW), paired(others, tasks, num_resamples=FEW)
    assert there.difference.value == pytest.approx(-back.difference.value)
    assert (there.num_better, there.num_worse) == (back.num_worse, back.num_better)
    assert there.p_value == back.p_value


@given(suites())
def test_a_condition_does_not_differ_from_itself(tasks: list[np.ndarray]) -> None:
    same = paired(tasks, tasks, num_resamples=FEW)
    assert (same.difference.value, same.num_better, same.num_worse, same.p_value) == (0, 0, 0, 1)


def test_scenes_that_are_paired_cancel() -> None:
    """Hard scenes are hard in both: the difference is known better than either rate."""
    scenes = np.arange(50)[None] % 2
    after = scenes.copy()
    after[0, :2] = 1
    found, rate = paired([scenes], [after], num_resamples=2000), bootstrap([scenes], num_resamples=2000)
    assert found.difference.high - found.difference.low < 0.5 * (rate.high - rate.low)


@pytest.mark.parametrize("num_runs", [1, 3])
def test_ninety_five_of_a_hundred_intervals_cover_the_truth(num_runs: int) -> None:
    """Four tasks of 50 scenes; each scene has its own chance, drawn anew for every evaluation."""
    rng = np.random.default_rng(1)
    covered = 0
    for trial in range(300):
        tasks = []
        for alpha in (0.5, 1.0, 2.0, 4.0):
            chances = rng.beta(alpha, 1.0, 50)
            tasks.append((rng.random((num_runs, 50)) < chances).astype(int))
        interval = bootstrap(tasks, num_resamples=400, seed=trial)
        truth = np.mean([alpha / (alpha + 1) for alpha in (0.5, 1.0, 2.0, 4.0)])
        covered += interval.low <= truth <= interval.high
    assert 0.92 <= covered / 300 <= 0.985


def test_runs_that_differ_as_wholes_widen_the_interval() -> None:
    alike = np.tile(np.arange(50) % 2, (3, 1))
    apart = np.stack([np.zeros(50), np.arange(50) % 2, np.ones(50)])
    assert success_rate([alike]) == success_rate([apart])
    narrow, wide = bootstrap([alike] * 4, num_resamples=1000), bootstrap([apart] * 4, num_resamples=1000)
    assert wide.high - wide.low > 3 * (narrow.high - narrow.low)


@pytest.mark.parametrize(
    ("better", "worse", "p_value"), [(0, 0, 1.0), (5, 0, 2 / 32), (1, 5, 14 / 64), (3, 3, 1.0), (0, 2000, 0.0)]
)
def test_the_sign_test_is_exact(better: int, worse: int, p_value: float) -> None:
    assert sign_test(better, worse) == pytest.approx(p_value, abs=1e-300)


def test_wilson_at_a_known_value() -> None:
    interval = wilson(0.5, 10)
    assert (round(interval.low, 4), round(interval.high, 4)) == (0.2366, 0.7634)
    assert wilson(0.0, 50).high > 0.07


@settings(max_examples=10)
@given(st.sampled_from([[], [[]], [[[0, 2]]], [[[0, 1]], [[0, 1], [1, 1]]], [[0, 1]]]))
def test_what_are_no_outcomes_is_refused(tasks: Any) -> None:
    with pytest.raises(ValueError, match=r"expected|outcomes"):
        bootstrap(tasks)


def test_a_scene_is_better_by_its_mean_however_many_runs_there_were() -> None:
    found = paired([[[1, 1, 0], [0, 0, 0]]], [[[1, 1, 0], [0, 1, 0], [1, 1, 0], [0, 1, 1]]], num_resamples=FEW)
    assert (found.num_better, found.num_worse) == (2, 0)


def test_other_scenes_are_not_paired() -> None:
    with pytest.raises(ValueError, match="same scenes"):
        paired([[[0, 1]]], [[[0, 1, 1]]])
