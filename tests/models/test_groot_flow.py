"""Laws of GR00T's flow: the other direction than pi0.5's, buckets cut towards zero, a field solved exactly."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dual_system.models import flow
from dual_system.models.groot import flow as groot_flow

SHAPE = (2, 4, 6)


def _pair(seed: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(SHAPE, generator=generator), torch.randn(SHAPE, generator=generator)


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 1000), time=st.floats(0, 1, width=32))
def test_it_is_pi05s_path_read_backwards(seed: int, time: float) -> None:
    actions, noise = _pair(seed)
    ours = groot_flow.noised(actions, noise, torch.full((2,), time))
    torch.testing.assert_close(ours, flow.noised(actions, noise, torch.full((2,), 1 - time)), atol=1e-5, rtol=0)
    assert torch.equal(groot_flow.target_velocity(actions, noise), -flow.target_velocity(actions, noise))


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 1000), num_steps=st.integers(1, 30))
def test_sampler_recovers_the_data_from_the_true_velocity(seed: int, num_steps: int) -> None:
    actions, noise = _pair(seed)
    steps = list(groot_flow.euler(lambda _, x: groot_flow.target_velocity(actions, noise), noise, num_steps))
    assert [step.index for step in steps] == list(range(num_steps))
    torch.testing.assert_close(steps[-1].actions, actions, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("time", "bucket"), [(0.0, 0), (-0.0006, 0), (0.9999, 999), (0.25, 250), (1.0, 1000)])
def test_buckets_are_cut_towards_zero(time: float, bucket: int) -> None:
    assert groot_flow.time_buckets(torch.tensor([time]), 1000).tolist() == [bucket]


def test_training_times_lean_towards_noise_and_stay_in_range() -> None:
    times = groot_flow.sample_times(20_000, torch.Generator().manual_seed(0))
    assert -0.0011 < times.min() < 0.0
    assert times.max() <= 1.0
    assert times.mean().item() == pytest.approx((0.999 - 0.6) / 0.999, abs=0.01)  # Beta(1.5, 1) has mean 0.6


def test_a_sampler_without_steps_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1 step, came 0"):
        groot_flow.euler_buckets(0, 1000)
