"""A scene with the PandaOmron in it: reset, advanced by whole control steps, saved and restored."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.kitchen import omron
from dual_system.tasks.kitchen.bay import ROBOT_STAND, build_bay
from dual_system.tasks.kitchen.control import Controller, Goal
from dual_system.tasks.kitchen.layout import StateReader
from dual_system.tasks.kitchen.plan import Scene
from dual_system.tasks.kitchen.predicates import View

SETTLING_STEPS = 4
"""Control steps before the first observation: objects come to rest."""

_PARTS = mujoco.mjtState.mjSTATE_INTEGRATION  # with the solver's warm start: restoring is exact to the bit


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldState:
    """Everything that changes in a scene."""

    integration: Array
    goal: Goal


class World:
    """One scene with the robot. Poses and contacts always belong to the current state."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        spec, self.bay = build_bay(scene.plan)
        spec.attach(omron.panda_omron_spec(), prefix="", site=ROBOT_STAND)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.view = View.of(self.model, self.data, self.bay)
        self.controller = Controller(self.model)
        self._reader = StateReader(self.model)
        self.reset()

    def reset(self) -> None:
        """Puts everything to the scene's start and lets it settle."""
        mujoco.mj_resetData(self.model, self.data)
        self.bay.start(self.model, self.data)
        omron.start(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        self.controller.begin(self.data)
        for _ in range(SETTLING_STEPS):
            self.controller.advance(self.data, np.zeros(12))

    def advance(self, action: Array) -> None:
        """Performs an action (12,) for one control step of 50 ms."""
        self.controller.advance(self.data, action)

    def state(self) -> Array:
        """Returns the robot's state (53,)."""
        return self._reader.state(self.data)

    def save(self) -> WorldState:
        """Returns a copy of everything that `load` needs to continue exactly."""
        integration = np.empty(mujoco.mj_stateSize(self.model, _PARTS))
        mujoco.mj_getState(self.model, self.data, integration, _PARTS)
        return WorldState(integration=integration, goal=self.controller.goal)

    def load(self, state: WorldState) -> None:
        """Restores a saved state of the same scene, in this or another process."""
        mujoco.mj_setState(self.model, self.data, state.integration, _PARTS)
        mujoco.mj_forward(self.model, self.data)
        self.controller.goal = state.goal
