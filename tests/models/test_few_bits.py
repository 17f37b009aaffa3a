"""Differences in few bits: what is lost, and what is not."""

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from dual_system.models.few_bits import STEP_OF_STD, narrowed, rounded, shape_of_codes, widened

BITS = sorted(STEP_OF_STD)
SHAPES = st.one_of(
    st.tuples(st.integers(1, 5), st.integers(1, 33)), st.tuples(st.integers(1, 4), st.just(1), st.integers(1, 5))
)


def drawn(shape: tuple[int, ...], seed: int, scale: float = 0.005) -> torch.Tensor:
    return scale * torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@given(bits=st.sampled_from(BITS), shape=SHAPES, seed=st.integers(0, 99))
def test_what_is_learned_is_what_is_stored(bits: int, shape: tuple[int, ...], seed: int) -> None:
    difference = drawn(shape, seed)
    few = narrowed(difference, bits)
    assert tuple(few.codes_RP.shape) == shape_of_codes(shape, bits)
    assert torch.equal(rounded(difference, bits), widened(few, shape, bits))


@example(bits=5, shape=(3, 1), seed=12)  # a step below the smallest normal number of half precision
@given(bits=st.sampled_from(BITS), shape=SHAPES, seed=st.integers(0, 99))
def test_every_number_is_half_a_step_beside_unless_it_lies_beyond_the_last(
    bits: int, shape: tuple[int, ...], seed: int
) -> None:
    difference = drawn(shape, seed)
    few = narrowed(difference, bits)
    steps = few.steps_R.float().reshape(-1, *[1] * (len(shape) - 1))
    is_within = difference.abs() < steps * 2 ** (bits - 1)
    error = (widened(few, shape, bits) - difference).abs()
    assert (error[is_within] <= 0.501 * steps.expand(shape)[is_within]).all()
    assert (widened(few, shape, bits).sign() == difference.sign())[difference != 0].all()


@pytest.mark.parametrize(("bits", "expected"), [(2, 0.1188), (3, 0.03744), (4, 0.01154), (5, 0.003495)])
def test_of_normal_numbers_as_little_is_lost_as_max_says(bits: int, expected: float) -> None:
    difference = drawn((8, 20_000), 1)
    lost = (rounded(difference, bits) - difference).square().mean() / difference.square().mean()
    assert lost == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("bits", BITS)
def test_the_gradient_is_the_differences_own(bits: int) -> None:
    difference = drawn((3, 7), 2).requires_grad_()
    weights = drawn((3, 7), 3, scale=1.0)
    (rounded(difference, bits) * weights).sum().backward()  # type: ignore[no-untyped-call]
    assert difference.grad is not None
    assert torch.equal(difference.grad, weights)


def test_what_has_not_moved_stays() -> None:
    few = narrowed(torch.zeros(2, 9), 3)
    assert not few.steps_R.any()
    assert torch.equal(widened(few, (2, 9), 3), torch.zeros(2, 9))


def test_vectors_and_other_numbers_of_bits_are_refused() -> None:
    with pytest.raises(ValueError, match="6 bits: a difference is stored in 2, 3, 4, 5"):
        narrowed(torch.ones(2, 2), 6)
    with pytest.raises(ValueError, match="a vector of 4 is stored as it is"):
        narrowed(torch.ones(4), 2)
