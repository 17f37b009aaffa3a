"""The Panda that the protocol is told of is the one that the simulator has."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from clock.limits import out_of_range
from dual_system.tasks.environment import make_environment
from sim_client.panda_robot import simulated_robot


@pytest.mark.parametrize("force_n", [-200.0, 200.0])
def test_a_hand_that_presses_on_things_measures_what_it_can_measure(force_n: float) -> None:
    """Out of range the clock stops the robot; 200 N take a finger 13 mm beyond its stop, and a grasp once took it 5."""
    with make_environment("PickHighlight", render=False) as environment:
        environment.reset(0)
        physics = environment.physics
        robot = simulated_robot(physics.robot, physics.state())
        for name, sign in zip(physics.robot.finger_joints, (1, -1), strict=True):
            physics.data.joint(name).qfrc_applied[:] = sign * force_n
        for _ in range(100):
            mujoco.mj_step(physics.model, physics.data)
            assert out_of_range(physics.state().astype(np.float32), robot) == ""
        stop_m = physics.robot.state_high[7] if force_n > 0 else physics.robot.state_low[7]
        assert abs(physics.state()[7] - stop_m) > 0.001
