"""The Panda's cameras in numpy are the simulator's."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from dual_system.models.arm import Poses
from dual_system.models.cameras import at_height, in_wrist_picture
from dual_system.policy.studio import Studio
from dual_system.tasks import sight
from dual_system.tasks.scene import FRONT, WRIST

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def studio() -> Iterator[Studio]:
    studio = Studio(image_px=64)
    yield studio
    studio.close()


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_what_the_front_camera_shows_is_where_it_is_and_where_the_wrist_camera_has_it(
    studio: Studio, seed: int
) -> None:
    studio.still(seed)
    physics = studio.physics
    points_m = np.random.default_rng(seed).uniform((-0.3, -0.3, 0.0), (0.1, 0.3, 0.1), (40, 3))
    front, wrist = (
        sight.project(sight.intrinsic(physics, camera, 1), sight.extrinsic(physics, camera), points_m)
        for camera in (FRONT, WRIST)
    )
    np.testing.assert_allclose(at_height(front, points_m[:, 2]), points_m, atol=1e-6)
    T = physics.tcp_transform()
    depth_m = (sight.extrinsic(physics, WRIST) @ np.column_stack([points_m, np.ones(40)]).T)[2]
    placed = in_wrist_picture(points_m, Poses(T[:3, 3], T[:3, :3]))
    is_ahead = depth_m > 0
    assert is_ahead.any()
    np.testing.assert_allclose(placed[is_ahead], wrist[is_ahead][:, ::-1], atol=1e-3)
    assert np.isnan(placed[~is_ahead]).all()


def test_above_the_horizon_there_is_no_table() -> None:
    assert np.isnan(at_height([0.5, -3.0], 0.0)).all()
