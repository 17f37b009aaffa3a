"""The snap finds the place that a noisy code is of, the likelier of two places, and lets gradients through."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.small_pair.place_code import NUM_PLACE_FEATURES, place_features, snap_to_code

HALF_PX = st.integers(0, 511).map(lambda number: number / 2)
PLACES = st.tuples(HALF_PX, HALF_PX)


def code(yx_px: tuple[float, float]) -> torch.Tensor:
    return torch.from_numpy(place_features(yx_px))


@given(yx_px=PLACES)
def test_a_code_is_its_own_nearest(yx_px: tuple[float, float]) -> None:
    torch.testing.assert_close(snap_to_code(code(yx_px)), code(yx_px))


@given(seed=st.integers(0, 2**32 - 1))
def test_no_place_of_the_grid_is_nearer(seed: int) -> None:
    numbers = torch.randn(NUM_PLACE_FEATURES, generator=torch.Generator().manual_seed(seed))
    found = float((snap_to_code(numbers) - numbers).square().sum())
    rng = np.random.default_rng(seed)
    others = [code((y, x)) for y, x in rng.integers(0, 512, size=(50, 2)) / 2]
    assert found <= min(float((other - numbers).square().sum()) for other in others) + 1e-4


@given(right=PLACES, other=PLACES, weight=st.floats(0.0, 0.3))
def test_of_a_mean_of_two_places_it_is_the_likelier(
    right: tuple[float, float], other: tuple[float, float], weight: float
) -> None:
    found = snap_to_code((1 - weight) * code(right) + weight * code(other))
    coordinates_px = (found[-2:] / (2 * 3**0.5) + 0.5) * 256
    off_px = (coordinates_px - torch.tensor(right)).abs().max()
    assert off_px < 2  # the mean's own coordinates may be off by 76


@given(num_rest=st.integers(0, 5), seed=st.integers(0, 99))
def test_what_is_no_code_is_left(num_rest: int, seed: int) -> None:
    numbers = torch.randn(2, 3, NUM_PLACE_FEATURES + num_rest, generator=torch.Generator().manual_seed(seed))
    snapped = snap_to_code(numbers)
    assert snapped.shape == numbers.shape
    assert torch.equal(snapped[..., NUM_PLACE_FEATURES:], numbers[..., NUM_PLACE_FEATURES:])
    assert torch.equal(snapped[..., :NUM_PLACE_FEATURES], snap_to_code(numbers[..., :NUM_PLACE_FEATURES]))


def test_a_batch_is_snapped_one_by_one_and_gradients_pass() -> None:
    numbers = torch.randn(3, 2, NUM_PLACE_FEATURES, generator=torch.Generator().manual_seed(0), requires_grad=True)
    snapped = snap_to_code(numbers)
    torch.testing.assert_close(snapped[1, 0], snap_to_code(numbers[1, 0]))
    slopes = torch.randn(snapped.shape, generator=torch.Generator().manual_seed(1))
    (snapped * slopes).sum().backward()
    torch.testing.assert_close(numbers.grad, slopes)


def test_cognition_that_is_too_small_for_a_code_is_refused() -> None:
    with pytest.raises(ValueError, match="a place's code is 26 numbers, cognition has 25"):
        snap_to_code(torch.zeros(2, 25))
