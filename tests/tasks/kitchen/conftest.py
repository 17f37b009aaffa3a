"""A bay with a stand-in for a robot: a hand that is put anywhere."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence

os.environ.setdefault("MUJOCO_GL", "egl")  # before anything imports mujoco

import mujoco
import numpy as np
import pytest

from dual_system.tasks.kitchen.bay import build_bay
from dual_system.tasks.kitchen.catalogue import draw_scene
from dual_system.tasks.kitchen.goals import GOAL_SETS, draw_goal_scene
from dual_system.tasks.kitchen.plan import Scene
from dual_system.tasks.kitchen.predicates import GRIP_SITE, HAND, Memory, View, fired, remember
from dual_system.tasks.panda import ROBOT_BIT, WORLD_BIT

AWAY = (0.0, -3.0, 1.0)
HAND_HALF_M = 0.01


class Played:
    """One scene, compiled, whose parts a test moves by hand."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        spec, self.bay = build_bay(scene.plan)
        hand = spec.worldbody.add_body(name=HAND, gravcomp=1.0)
        hand.add_freejoint(name=HAND)  # a mocap body would not touch what stands still
        hand.add_site(name=GRIP_SITE)
        hand.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=[HAND_HALF_M] * 3, contype=ROBOT_BIT, conaffinity=WORLD_BIT, group=3
        )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.view = View.of(self.model, self.data, self.bay)
        self.memory: Memory
        self.reset()

    def reset(self) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self.bay.start(self.model, self.data)
        self.hand_at(AWAY)
        self.memory = remember(self.view, None)

    def turn(self, joint: str, value: float) -> None:
        self.data.qpos[self.model.joint(joint).qposadr[0]] = value
        mujoco.mj_forward(self.model, self.data)

    def put(self, name: str, xyz_m: Sequence[float], yaw_rad: float = 0.0) -> None:
        first = int(self.model.joint(name).qposadr[0])
        self.data.qpos[first : first + 7] = [*xyz_m, np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2)]
        mujoco.mj_forward(self.model, self.data)

    def hand_at(self, xyz_m: Sequence[float]) -> None:
        self.put(HAND, xyz_m)

    def fired(self) -> int | None:
        """One more observation: what is remembered, then which goal fires."""
        self.memory = remember(self.view, self.memory)
        return fired(self.view, self.memory, self.scene.goals)

    def settle(self, seconds: float = 1.0) -> None:
        mujoco.mj_step(self.model, self.data, round(seconds / self.model.opt.timestep))
        mujoco.mj_forward(self.model, self.data)


@pytest.fixture(scope="session")
def built() -> Callable[..., Played]:
    """Builds each scene once; it comes back as it starts."""

    @functools.cache
    def once(name: str, seed: int) -> Played:
        return Played(draw_goal_scene(name, seed) if name in GOAL_SETS else draw_scene(name, seed))

    def of(name: str, seed: int = 0) -> Played:
        played = once(name, seed)
        played.reset()
        return played

    return of
