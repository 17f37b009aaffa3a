"""Laws of poses, screws and rectangles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dual_system.tasks.geometry import (
    Footprint,
    is_clear,
    pose,
    pose_of,
    rotation_log,
    screw_exp,
    screw_log,
    transform,
)

coordinates = st.floats(-2, 2)
twists = hnp.arrays(np.float64, 6, elements=st.floats(-1.7, 1.7))  # rotation vectors stay shorter than pi
footprints = st.builds(
    lambda x, y, hx, hy, yaw: Footprint(center_m=(x, y), half_m=(hx, hy), yaw_rad=yaw),
    coordinates,
    coordinates,
    st.floats(0.01, 0.5),
    st.floats(0.01, 0.5),
    st.floats(0, 2 * np.pi),
)


@given(twists)
def test_screw_log_is_the_inverse_of_screw_exp(twist: np.ndarray) -> None:
    np.testing.assert_allclose(screw_log(screw_exp(twist)), twist, atol=1e-6)


@given(twists, st.floats(0, 1), st.floats(0, 1))
def test_motion_along_one_screw_adds_up(twist: np.ndarray, a: float, b: float) -> None:
    np.testing.assert_allclose(screw_exp(a * twist) @ screw_exp(b * twist), screw_exp((a + b) * twist), atol=1e-9)


@given(twists)
def test_pose_of_is_the_inverse_of_transform(twist: np.ndarray) -> None:
    T = screw_exp(twist)
    np.testing.assert_allclose(transform(pose_of(T)), T, atol=1e-9)


def test_yaw_turns_about_the_vertical() -> None:
    np.testing.assert_allclose(rotation_log(transform(pose(1, 2, 3, 0.4))[:3, :3]), [0, 0, 0.4], atol=1e-12)


@given(footprints, footprints, st.floats(0, 0.3))
def test_being_clear_is_mutual(a: Footprint, b: Footprint, gap_m: float) -> None:
    assert is_clear(a, b, gap_m) == is_clear(b, a, gap_m)


@given(footprints, footprints)
def test_clear_rectangles_share_no_corner_or_center(a: Footprint, b: Footprint) -> None:
    if not is_clear(a, b, 0.0):
        return
    corners = np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)]) * b.half_m
    world = corners @ b.axes() + b.center_m
    local = np.abs((world - a.center_m) @ a.axes().T)
    assert not np.any(np.all(local < np.array(a.half_m) - 1e-9, axis=1))


@pytest.mark.parametrize(("distance_m", "clear"), [(0.0799, False), (0.0801, True)])
def test_gap_counts_from_side_to_side(distance_m: float, clear: bool) -> None:
    a = Footprint(center_m=(0, 0), half_m=(0.02, 0.02))
    b = Footprint(center_m=(distance_m, 0), half_m=(0.02, 0.02))
    assert is_clear(a, b, 0.04) is clear
