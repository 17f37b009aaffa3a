"""Rows that are given to a chunk: they come out unchanged, they do not count, and without any nothing changes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dual_system.models import flow
from dual_system.models.pi05.committed import DONE, Committed, draw_counts, first_rows, row_styles
from dual_system.models.pi05.pounce import Pounce
from dual_system.models.pounce.configs import tiny_cpu
from dual_system.models.pounce.initialise import random_pounce

B, N, A = 2, 6, 32


@pytest.fixture(scope="module")
def model() -> Pounce:
    return random_pounce(replace(tiny_cpu(horizon=N), num_steps=3), 0).eval().requires_grad_(False)


def noise_of(seed: int) -> Tensor:
    return torch.randn(B, N, A, generator=torch.Generator().manual_seed(seed))


def chunk(model: Pounce, counts: tuple[int, ...] | None, rows_BNA: Tensor | None = None) -> Tensor:
    given_rows = None
    if counts is not None:
        rows_BNA = torch.zeros(B, N, A) if rows_BNA is None else rows_BNA
        given_rows = Committed(rows=rows_BNA, is_given=first_rows(torch.tensor(counts), N))
    *_, last = model.sample(model.config.example_inputs(B), noise_of(1), model.step_table(), given=given_rows)
    return last.actions


@given(counts=st.tuples(st.integers(0, N - 1), st.integers(0, N - 1)), seed=st.integers(0, 2**31))
@settings(max_examples=15, deadline=None)
def test_given_rows_come_out_bit_for_bit(model: Pounce, counts: tuple[int, int], seed: int) -> None:
    rows = noise_of(seed)
    made = chunk(model, counts, rows)
    for sample, count in enumerate(counts):
        assert torch.equal(made[sample, :count], rows[sample, :count])
        assert not torch.isclose(made[sample, count:], rows[sample, count:]).all()


def test_a_sampler_without_given_rows_is_the_ordinary_one_bit_for_bit(model: Pounce) -> None:
    assert torch.equal(chunk(model, (0, 0), torch.full((B, N, A), torch.nan)), chunk(model, None))


def test_the_rest_follows_from_what_is_given_and_not_from_what_stands_beyond(model: Pounce) -> None:
    rows, other = noise_of(2), noise_of(3)
    beyond = torch.where(first_rows(torch.tensor([2, 2]), N)[..., None], rows, other)
    assert torch.equal(chunk(model, (2, 2), rows), chunk(model, (2, 2), beyond))
    assert (chunk(model, (2, 2), rows) - chunk(model, (2, 2), other))[:, 2:].abs().mean() > 1e-3


def test_one_samples_rows_do_not_reach_another(model: Pounce) -> None:
    rows = noise_of(2)
    torch.testing.assert_close(chunk(model, (3, 0), rows)[1], chunk(model, (0, 0), rows)[1], atol=1e-6, rtol=0)


def test_a_rows_style_is_that_of_its_own_flow_time(model: Pounce) -> None:
    """The twin: every row's time through the time network, one by one."""
    pi05, expert = model.pi05, model.pi05.expert
    is_given = first_rows(torch.tensor([2, 0]), N)
    time_B = torch.tensor([0.3, 0.8])
    time_BN = torch.where(is_given, DONE, time_B[:, None])
    styles_MSR1E = expert.styles(pi05.time_condition(time_BN.flatten()))
    direct_MSBNE = styles_MSR1E.squeeze(3).unflatten(2, (B, N))
    done = expert.styles(pi05.time_condition(torch.full((1,), DONE)))
    chosen = row_styles(expert.styles(pi05.time_condition(time_B)), done, is_given)
    torch.testing.assert_close(chosen, direct_MSBNE, atol=1e-6, rtol=0)
    torch.testing.assert_close(model.step_table().done, done)
    x, cache = noise_of(4), model.prefill(model.config.example_inputs(B))
    torch.testing.assert_close(
        pi05.velocity_at(x, time_B, cache, is_given_BN=is_given),
        pi05.velocity(x, direct_MSBNE, cache),
        atol=1e-5,
        rtol=0,
    )


def loss_of(model: Pounce, counts: tuple[int, int] | None, actions_BNA: Tensor, noise_BNA: Tensor) -> Tensor:
    counted = None if counts is None else torch.tensor(counts)
    inputs, time_B = model.config.example_inputs(B), torch.tensor([0.4, 0.7])
    return model.loss(inputs, actions_BNA, noise_BNA, time_B, num_committed_B=counted)


def test_a_loss_without_given_rows_is_the_ordinary_one_bit_for_bit(model: Pounce) -> None:
    actions = model.config.example_actions(B)
    assert torch.equal(loss_of(model, (0, 0), actions, noise_of(5)), loss_of(model, None, actions, noise_of(5)))


def test_given_rows_are_clean_and_do_not_count(model: Pounce) -> None:
    """Their noise is not even looked at, and the mean is over the other rows alone."""
    actions, noise, counts = model.config.example_actions(B), noise_of(5), (2, 3)
    is_given = first_rows(torch.tensor(counts), N)
    without = noise.masked_fill(is_given[..., None], 100.0)
    assert torch.equal(loss_of(model, counts, actions, noise), loss_of(model, counts, actions, without))
    inputs, time_B = model.config.example_inputs(B), torch.tensor([0.4, 0.7])
    x = torch.where(is_given[..., None], actions, flow.noised(actions, noise, time_B))
    velocity = model.pi05.velocity_at(x, time_B, model.prefill(inputs), is_given_BN=is_given)
    error = (flow.target_velocity(actions, noise) - velocity).square()[..., : model.config.robot_action_dim]
    mean = sum(error[sample, count:].sum() for sample, count in enumerate(counts)) / (7 * error.shape[-1])
    torch.testing.assert_close(loss_of(model, counts, actions, noise), mean)


def test_counts_are_drawn_from_none_to_the_most() -> None:
    drawn = draw_counts(500, 3, torch.Generator().manual_seed(0))
    assert sorted(set(drawn.tolist())) == [0, 1, 2, 3]
    assert drawn.bincount().min() > 90


@pytest.mark.parametrize("counts", [(-1, 0), (N, 0)])
def test_a_chunk_without_a_row_to_make_is_refused(counts: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=rf"expected 0\.\.{N - 1} committed rows of {N}"):
        first_rows(torch.tensor(counts), N)


@pytest.mark.parametrize("most", [-1, N])
def test_a_config_that_would_give_every_row_is_refused(most: int) -> None:
    with pytest.raises(ValueError, match=rf"max_committed_rows must be 0\.\.{N - 1}, came {most}"):
        replace(tiny_cpu(horizon=N), max_committed_rows=most)
