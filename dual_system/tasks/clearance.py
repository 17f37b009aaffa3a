"""Distance from the tool to the nearest object that it could touch, which decides whether an arm may be nudged.

Objects are approximated by the boxes around their geoms. That is exact for cubes, pegs and walls, conservative for
round ones, and takes a tenth of a millisecond. An object between the fingers moves with the hand and does not count.
"""

from __future__ import annotations

import numpy as np

from dual_system.tasks import panda
from dual_system.tasks.physics import Physics

_WITHIN_REACH_M = 0.03  # of the tool point; nothing further away can be between the fingers


class Clearance:
    """Measures one physics."""

    def __init__(self, physics: Physics) -> None:
        self._physics = physics
        model = physics.model
        is_arm = model.geom_contype == panda.ROBOT_BIT
        self._geoms = np.flatnonzero((model.geom_conaffinity & panda.ROBOT_BIT != 0) & ~is_arm)
        self._centre_m, self._half_m = np.split(model.geom_aabb[self._geoms], 2, axis=1)
        self._body = model.geom_bodyid[self._geoms]
        self._root = model.body_rootid[self._body]

    def tool_m(self) -> float:
        """Returns the distance in m from the tool point to the nearest object not in the hand; 0 inside one."""
        data = self._physics.data
        R = data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        tool_m = self._physics.tcp_transform()[:3, 3] - data.geom_xpos[self._geoms]
        beyond_m = np.abs(np.einsum("nji,nj->ni", R, tool_m) - self._centre_m) - self._half_m
        distances_m = np.linalg.norm(np.maximum(beyond_m, 0.0), axis=1)
        for body in np.unique(self._body[distances_m < _WITHIN_REACH_M]):
            if self._physics.is_grasped(self._physics.model.body(body).name):
                distances_m[self._root == self._physics.model.body_rootid[body]] = np.inf
        return float(distances_m.min())
