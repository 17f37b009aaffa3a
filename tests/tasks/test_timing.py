"""Laws of time-optimal timing: limits hold, rest at both ends, nothing faster exists where the answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.tasks.timing import fastest, sample

LIMIT = 0.9


def curve(amplitudes: list[float], bends: list[float], num_points: int = 80) -> np.ndarray:
    s = np.linspace(0, 1, num_points)[:, None]
    return np.array(amplitudes) * s + np.array(bends) * np.sin(2 * s)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-2, 2), min_size=3, max_size=3), st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=3))
def test_speed_and_acceleration_limits_hold(amplitudes: list[float], bends: list[float]) -> None:
    path = curve(amplitudes, bends)
    if np.abs(np.diff(path, axis=0)).max() < 1e-3:
        return
    timing = fastest(path, max_speed=LIMIT, max_acceleration=LIMIT)
    period_s = 0.02
    at_s = np.arange(0, timing.duration_s, period_s)
    grid = np.linspace(0, 1, len(path))
    q = np.stack([np.interp(timing.fraction(at_s), grid, joint) for joint in path.T], axis=1)
    velocity = np.diff(q, axis=0) / period_s
    assert np.abs(velocity).max() <= LIMIT * 1.01
    # Between its points the path is a polygon; averaging over a tenth of a second takes its corners out.
    smooth = np.lib.stride_tricks.sliding_window_view(velocity, 5, axis=0).mean(axis=-1)
    if len(smooth) > 5:
        assert np.abs(smooth[5:] - smooth[:-5]).max() / (5 * period_s) <= LIMIT * 1.03


@given(st.floats(0.05, 3.0), st.integers(20, 200))
@settings(max_examples=40, deadline=None)
def test_straight_path_takes_the_time_of_a_trapezoid(length: float, num_points: int) -> None:
    timing = fastest(np.linspace(0, length, num_points)[:, None], max_speed=LIMIT, max_acceleration=LIMIT)
    if length * LIMIT > LIMIT**2:
        expected_s = length / LIMIT + LIMIT / LIMIT
    else:
        expected_s = 2 * np.sqrt(length / LIMIT)
    assert timing.duration_s == pytest.approx(expected_s, rel=0.02)


def test_time_never_runs_backwards() -> None:
    timing = fastest(curve([1.0, -0.5, 0.2], [0.4, 0.1, -0.3]), max_speed=LIMIT, max_acceleration=LIMIT)
    assert np.all(np.diff(timing.times_s) > 0)
    assert np.all(np.diff(timing.fraction(np.linspace(0, timing.duration_s, 500))) > 0)


def test_each_grid_point_is_passed_at_its_time() -> None:
    timing = fastest(curve([1.0, -0.5, 0.2], [0.4, 0.1, -0.3]), max_speed=LIMIT, max_acceleration=LIMIT)
    np.testing.assert_allclose(timing.fraction(timing.times_s), np.linspace(0, 1, 80), atol=1e-9)


def test_going_there_and_coming_back_take_the_same_time() -> None:
    path = curve([1.0, -0.5, 0.2], [0.4, 0.1, -0.3])
    there, back = (fastest(p, max_speed=LIMIT, max_acceleration=LIMIT).duration_s for p in (path, path[::-1]))
    assert there == pytest.approx(back, rel=0.02)


def test_samples_start_and_end_on_the_path() -> None:
    path = curve([1.0, -0.5, 0.2], [0.4, 0.1, -0.3])
    samples = sample(path, fastest(path, max_speed=LIMIT, max_acceleration=LIMIT), 0.05)
    np.testing.assert_allclose(samples[[0, -1]], path[[0, -1]])


def test_standing_still_takes_no_time() -> None:
    path = np.ones((10, 7))
    timing = fastest(path, max_speed=LIMIT, max_acceleration=LIMIT)
    assert timing.duration_s == 0
    np.testing.assert_array_equal(sample(path, timing, 0.05), path[:2])


@given(st.integers(0, 2**32 - 1), st.floats(-12, -5), st.integers(20, 120))
@settings(max_examples=60, deadline=None)
def test_a_path_of_noise_takes_hardly_any_time(seed: int, exponent: float, num_points: int) -> None:
    path = 10.0**exponent * np.random.default_rng(seed).normal(size=(num_points, 7))
    assert fastest(path, max_speed=LIMIT, max_acceleration=LIMIT).duration_s < 1.0


@given(st.integers(0, 2**32 - 1), st.floats(-9, 0), st.integers(20, 120))
@settings(max_examples=60, deadline=None)
def test_a_motion_of_any_size_ends(seed: int, exponent: float, num_points: int) -> None:
    rng = np.random.default_rng(seed)
    path = 10.0**exponent * curve(rng.normal(size=3).tolist(), rng.normal(size=3).tolist(), num_points)
    travel = np.abs(np.diff(path, axis=0)).sum(axis=0).max()
    duration_s = fastest(path, max_speed=LIMIT, max_acceleration=LIMIT).duration_s
    assert duration_s <= 4 * (2 * np.sqrt(travel / LIMIT) + travel / LIMIT) + 1e-3
