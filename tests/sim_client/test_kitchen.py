"""The kitchen's tasks in sim-client: which names there are, and the robot that episodes are opened for."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from dual_system.tasks.kitchen.catalogue import TASKS
from dual_system.tasks.kitchen.environment import KitchenEnvironment
from dual_system.tasks.kitchen.goals import GOAL_SETS
from dual_system.tasks.task import TaskError, task_names
from protocol import checks
from sim_client import worlds
from sim_client.kitchen_robot import panda_omron
from sim_client.robot_file import read_robot

ROOT = Path(__file__).parents[2]


def test_there_are_the_sixteen_the_twenty_four_and_the_goal_sets() -> None:
    names = worlds.names()
    assert len(names) == len(set(names))
    assert set(names) == {*task_names(), *TASKS, *GOAL_SETS}
    for name in names:
        worlds.require(name)
    with pytest.raises(TaskError, match="unknown task 'OpenDrawers'"):
        worlds.require("OpenDrawers")


def test_the_robot_is_the_one_of_the_example() -> None:
    """Whoever serves by the file serves the kitchen, and the other way round."""
    robot = panda_omron()
    checks.check_robot(robot)
    described = read_robot(ROOT / "examples/robots/panda_omron.toml").describe(np.zeros(53, np.float32), (128, 128))
    same = {field.name for field in dataclasses.fields(robot)} - {
        "at_exit", "dimensions", "home", "max_lead", "max_picture_age_ns", "state_high", "state_low",
    }  # fmt: skip
    assert len(same) > 12
    for name in same:
        np.testing.assert_array_equal(getattr(robot, name), getattr(described, name), err_msg=name)
    for ours, theirs in zip(robot.dimensions, described.dimensions, strict=True):
        assert (ours.name, ours.kind, ours.at_stop) == (theirs.name, theirs.kind, theirs.at_stop)
    assert (robot.state_high >= 0.99).sum() > 40
    assert (robot.state_low == -robot.state_high).all()


def test_a_kitchen_episode_is_of_its_own_suite_and_no_longer_than_the_papers() -> None:
    with worlds.open_world("OpenDrawer", render=False, max_steps=1300) as world:
        assert isinstance(world, KitchenEnvironment)
        first = world.reset(0)
        robot = worlds.robot_of(world, first)
        assert (len(first.state), len(first.command)) == (robot.num_proprio, robot.action_dim)
        assert ((robot.state_low <= first.state) & (first.state <= robot.state_high)).all()
        assert worlds.suite_of(world) == "RoboCasa-DC"
        assert world._max_steps == 1000
        with pytest.raises(TaskError, match="OpenDrawer has no difficulties"):
            world.reset(0, "easy")
