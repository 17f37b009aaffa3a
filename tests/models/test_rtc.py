"""Real-time chunking: the flow is pulled to the previous rows where it must be, and left alone where there are none."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dual_system.models import flow
from dual_system.models.pi05 import rtc as rtc
from dual_system.models.pounce.configs import tiny_cpu
from dual_system.models.pounce.initialise import random_pounce

N, A, STEPS = 20, 32, 10
Velocity = Callable[[int, Tensor], Tensor]


@pytest.fixture(scope="module")
def velocity_at() -> Velocity:
    config = tiny_cpu()
    model = random_pounce(config, 0).eval().requires_grad_(False)
    cache, table = model.prefill(config.example_inputs(1)), model.step_table()
    return lambda index, x_BNA: model.pi05.velocity(x_BNA, table.styles[index], cache)


def chunk(velocity_at: Velocity, seed: int, guide: rtc.Guide | None = None) -> Tensor:
    noise = torch.randn(1, N, A, generator=torch.Generator().manual_seed(seed))
    flowing = velocity_at if guide is None else rtc.guided(velocity_at, guide, STEPS)
    *_, last = flow.euler(flowing, noise, STEPS)
    return last.actions


def guide_to(target_BNA: Tensor, num_previous: int, num_committed: int) -> rtc.Guide:
    weight_N = rtc.soft_mask(N, num_previous, num_committed)
    return rtc.Guide(target=target_BNA, weight=weight_N[None, :, None].expand_as(target_BNA))


def test_all_rows_committed_reproduce_the_previous_chunk(velocity_at: Velocity) -> None:
    previous, plain = chunk(velocity_at, 0), chunk(velocity_at, 1)
    continued = chunk(velocity_at, 1, guide_to(previous, N, N))
    assert (continued - previous).abs().mean() < 0.06 * (plain - previous).abs().mean()


def test_no_rows_leave_every_bit_as_it_was(velocity_at: Velocity) -> None:
    guide = guide_to(torch.full((1, N, A), 1e3), 0, 0)
    torch.testing.assert_close(chunk(velocity_at, 1, guide), chunk(velocity_at, 1), rtol=0, atol=0)


def test_committed_rows_are_met_closer_than_the_rest(velocity_at: Velocity) -> None:
    previous = chunk(velocity_at, 0)
    miss_N = (chunk(velocity_at, 1, guide_to(previous, 15, 5)) - previous).abs().mean(dim=(0, 2))
    assert miss_N[:5].mean() < 0.2 * miss_N[5:15].mean() < 0.2 * miss_N[15:].mean()


def test_the_pull_is_a_vector_jacobian_product() -> None:
    """Of a linear network, whose Jacobian is known."""
    matrix = torch.tensor([[0.5, -1.0], [2.0, 0.25]])
    target, x = torch.tensor([[[1.0, -2.0]]]), torch.tensor([[[0.3, 0.7]]])
    guide = rtc.Guide(target=target, weight=torch.ones_like(target))
    found = rtc.guided(lambda index, x_BNA: x_BNA @ matrix.T, guide, 2)(1, x)
    jacobian = torch.eye(2) - 0.5 * matrix  # of what is reached from t = 1/2
    expected = x @ matrix.T - rtc.pull(0.5) * ((target - x @ jacobian.T) @ jacobian)
    torch.testing.assert_close(found, expected)


@given(st.data())
def test_the_mask_is_one_then_falls_then_is_zero(data: st.DataObject) -> None:
    num_previous = data.draw(st.integers(0, N))
    num_committed = data.draw(st.integers(0, num_previous))
    mask = rtc.soft_mask(N, num_previous, num_committed)
    assert (mask[:num_committed] == 1).all()
    assert (mask[num_previous:] == 0).all()
    assert (mask.diff()[max(0, num_committed - 1) : num_previous] < 0).all()


def test_the_pull_is_the_papers_and_clipped() -> None:
    assert rtc.pull(0.5) == pytest.approx(2.0)
    assert rtc.pull(0.75) == pytest.approx((0.0625 + 0.5625) / 0.1875)
    assert [rtc.pull(time) for time in (1.0, 0.99, 0.0)] == [rtc.MAX_WEIGHT] * 3


@pytest.mark.parametrize(("previous", "committed"), [(21, 0), (5, 6), (5, -1)])
def test_impossible_numbers_of_rows_are_refused(previous: int, committed: int) -> None:
    with pytest.raises(ValueError, match=f"came {committed} committed of {previous}"):
        rtc.soft_mask(N, previous, committed)
