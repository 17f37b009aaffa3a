"""Laws of the flow: the path's ends and slope, a field the sampler must solve exactly, the two means."""

from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dual_system.models import flow

SHAPE = (2, 4, 6)


def _pair(seed: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(SHAPE, generator=generator), torch.randn(SHAPE, generator=generator)


@settings(deadline=None)
@given(seed=st.integers(0, 1000))
def test_path_begins_in_noise_and_ends_in_data(seed: int) -> None:
    actions, noise = _pair(seed)
    assert torch.equal(flow.noised(actions, noise, torch.ones(2)), noise)
    assert torch.equal(flow.noised(actions, noise, torch.zeros(2)), actions)


@settings(deadline=None)
@given(seed=st.integers(0, 1000), early=st.floats(0, 1), late=st.floats(0, 1))
def test_target_is_the_slope_of_the_path(seed: int, early: float, late: float) -> None:
    actions, noise = _pair(seed)
    rise = flow.noised(actions, noise, torch.full((2,), late)) - flow.noised(actions, noise, torch.full((2,), early))
    torch.testing.assert_close(rise, (late - early) * flow.target_velocity(actions, noise), atol=1e-5, rtol=0)


@settings(deadline=None)
@given(seed=st.integers(0, 1000), num_steps=st.integers(1, 30))
def test_sampler_recovers_the_data_from_the_true_velocity(seed: int, num_steps: int) -> None:
    actions, noise = _pair(seed)
    truth = flow.target_velocity(actions, noise)
    times = flow.euler_times(num_steps)
    for step in flow.euler(lambda _index, _x: truth, noise, num_steps):
        reached = [*times, 0.0][step.index + 1]
        on_path = flow.noised(actions, noise, torch.full((2,), reached))
        torch.testing.assert_close(step.actions, on_path, atol=1e-5, rtol=0)


@settings(deadline=None)
@given(num_steps=st.integers(1, 50))
def test_sampler_looks_at_falling_times_once_each(num_steps: int) -> None:
    times = flow.euler_times(num_steps)
    assert times[0] == 1.0
    assert all(0.0 < later < earlier for earlier, later in pairwise(times))
    seen: list[int] = []

    def velocity_at(index: int, x: Tensor) -> Tensor:
        seen.append(index)
        return x

    list(flow.euler(velocity_at, torch.ones(1, 1, 1), num_steps))
    assert seen == list(range(num_steps))


@settings(deadline=None)
@given(seed=st.integers(0, 1000), real=st.integers(1, SHAPE[-1]))
def test_the_two_means_differ_by_the_padding(seed: int, real: int) -> None:
    loss = _pair(seed)[0].square()
    loss[..., real:] = 0.0
    over_real, over_all = flow.mean_loss(loss, real), flow.mean_loss(loss, real, over="all")
    torch.testing.assert_close(over_all, over_real * real / SHAPE[-1])


def test_default_mean_ignores_padded_dims() -> None:
    loss = torch.ones(1, 2, 4)
    loss[..., 3] = 100.0
    assert flow.mean_loss(loss, 3).item() == 1.0


def test_times_follow_the_stretched_beta_and_their_seed() -> None:
    times = flow.sample_times(20_000, torch.Generator().manual_seed(0))
    assert times.min() >= flow.TIME_MIN
    assert times.max() <= 1.0
    assert times.mean().item() == pytest.approx(0.6 * flow.TIME_SPAN + flow.TIME_MIN, abs=0.01)
    assert (times < 0.5).float().mean().item() == pytest.approx(0.5**1.5, abs=0.02)  # the cdf of Beta(1.5, 1) is x^1.5
    assert torch.equal(times, flow.sample_times(20_000, torch.Generator().manual_seed(0)))


def test_refusals_say_what_came() -> None:
    with pytest.raises(ValueError, match="at least 1 step, came 0"):
        flow.euler_times(0)
    with pytest.raises(ValueError, match=r"1\.\.6 .* came 7"):
        flow.mean_loss(torch.zeros(SHAPE), 7)
    with pytest.raises(ValueError, match="'real' or 'all', came 'some'"):
        flow.mean_loss(torch.zeros(SHAPE), 6, over="some")
