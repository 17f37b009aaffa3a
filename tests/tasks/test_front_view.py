"""What learns without a simulator sees points where the simulator's camera does."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dual_system.tasks.environment import make_environment
from dual_system.tasks.front_view import front_pixels
from dual_system.tasks.scene import FRONT
from dual_system.tasks.sight import extrinsic, intrinsic, project

PHYSICS = make_environment("PickHighlight", render=False).physics
ON_THE_TABLE = st.tuples(st.floats(-0.4, 0.2), st.floats(-0.4, 0.4), st.floats(0.0, 0.3))


@given(points=st.lists(ON_THE_TABLE, min_size=1, max_size=5), image_px=st.sampled_from([64, 256]))
def test_a_point_is_seen_where_mujocos_camera_sees_it(points: list[tuple[float, ...]], image_px: int) -> None:
    points_m = np.array(points)
    PHYSICS.reset()
    PHYSICS.refresh()
    seen_xy = project(intrinsic(PHYSICS, FRONT, image_px), extrinsic(PHYSICS, FRONT), points_m)
    np.testing.assert_allclose(front_pixels(points_m, image_px), seen_xy[:, ::-1], atol=1e-6)
