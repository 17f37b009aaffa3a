"""Statistics without keeping the numbers are those of the numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.data.statistics import QUANTILES, PixelHistogram, of_vectors


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(0, 3))
@settings(max_examples=30)
def test_a_histogram_of_pictures_is_as_good_as_the_pictures(seed: int, num_frames: int, num_before: int) -> None:
    rng = np.random.default_rng(seed)
    frames = rng.integers(rng.integers(200), 256, (num_frames, 5, 4, 3), np.uint8)
    parts = [PixelHistogram(), PixelHistogram()]
    for index, frame in enumerate(frames):
        parts[index >= num_before].add(frame)
    found = (parts[0] + parts[1]).statistics()
    values = frames.reshape(-1, 3) / 255
    expected = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    expected |= {name: np.quantile(values, q, axis=0, method="inverted_cdf") for name, q in QUANTILES.items()}
    for name, each in expected.items():
        np.testing.assert_allclose(np.ravel(found[name]), each, atol=1e-9, err_msg=name)
    assert np.shape(found["mean"]) == (3, 1, 1)
    assert found["count"] == [num_frames]


def test_columns_of_nothing_have_a_count_of_nothing() -> None:
    found = of_vectors(np.zeros((0, 2), np.float32))
    assert found["count"] == [0]
    assert np.isfinite(found["mean"]).all()


def test_truths_are_counted_as_shares() -> None:
    assert of_vectors(np.array([True, False, False, False]))["mean"] == [pytest.approx(0.25)]
