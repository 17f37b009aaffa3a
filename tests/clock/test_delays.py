"""Delays as the paper samples them (A.1): arithmetic mean, clipped at three sigma, in query order."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock.delays import in_order, log_normal_ns, modelled_ns
from protocol.messages import Delay, DelayKind

MS = 1_000_000
NUM_DRAWS = 20_000
PAPER = [(100 * MS, 0.05), (1_000 * MS, 0.05), (300 * MS, 0.3)]  # POUNCE interval, PONDER interval, compute delay


def draws(mean_ns: int, sigma: float, count: int = NUM_DRAWS) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.array([log_normal_ns(rng, mean_ns, sigma) for _ in range(count)], np.float64)


@pytest.mark.parametrize(("mean_ns", "sigma"), PAPER)
def test_the_arithmetic_mean_is_the_mean(mean_ns: int, sigma: float) -> None:
    assert draws(mean_ns, sigma).mean() == pytest.approx(mean_ns, rel=0.01)


@pytest.mark.parametrize(("mean_ns", "sigma"), PAPER)
def test_sigma_is_in_log_space(mean_ns: int, sigma: float) -> None:
    assert np.log(draws(mean_ns, sigma)).std() == pytest.approx(sigma, rel=0.02)


@pytest.mark.parametrize(("mean_ns", "sigma"), PAPER)
def test_draws_are_clipped_at_three_sigma(mean_ns: int, sigma: float) -> None:
    distance = (np.log(draws(mean_ns, sigma) / mean_ns) + sigma**2 / 2) / sigma
    assert np.abs(distance).max() == pytest.approx(3.0, abs=1e-6)


def test_no_sigma_is_no_spread() -> None:
    assert set(draws(300 * MS, 0.0, 10)) == {300 * MS}


def test_equal_seeds_draw_equal_delays() -> None:
    assert (draws(300 * MS, 0.3, 50) == draws(300 * MS, 0.3, 50)).all()


@given(mean_ns=st.integers(0, 10**12))
def test_a_fixed_delay_is_its_mean_and_draws_nothing(mean_ns: int) -> None:
    rng = np.random.default_rng(0)
    assert modelled_ns(Delay(kind=DelayKind.FIXED, mean_ns=mean_ns), rng) == mean_ns
    assert rng.standard_normal() == np.random.default_rng(0).standard_normal()


def test_a_measured_delay_is_not_known_beforehand() -> None:
    assert modelled_ns(Delay(kind=DelayKind.MEASURED, mean_ns=5), np.random.default_rng(0)) is None


def test_a_log_normal_delay_is_drawn() -> None:
    delay = Delay(kind=DelayKind.LOG_NORMAL, mean_ns=300 * MS, sigma=0.3)
    drawn = modelled_ns(delay, np.random.default_rng(3))
    assert drawn == log_normal_ns(np.random.default_rng(3), 300 * MS, 0.3)
    assert drawn is not None
    assert abs(math.log(drawn / (300 * MS))) < 1


@given(ready=st.lists(st.integers(0, 10**10), min_size=1, max_size=20))
def test_ready_times_keep_query_order(ready: list[int]) -> None:
    kept: list[int] = []
    for ready_ns in ready:
        kept.append(in_order(ready_ns, kept[-1] if kept else None))
    assert kept == sorted(kept)
    assert all(after >= before for after, before in zip(kept, ready, strict=True))


@given(ready=st.lists(st.integers(0, 10**10), min_size=1, max_size=20).map(sorted))
def test_ready_times_that_are_in_order_are_left_alone(ready: list[int]) -> None:
    assert [in_order(b, a) for a, b in zip([None, *ready], ready, strict=False)] == ready
