"""Environments by a task's name, the sixteen's or the kitchen's: all that episodes ask of either."""

from __future__ import annotations

from dual_system.tasks.environment import Environment, Snapshot, make_environment
from dual_system.tasks.kitchen.catalogue import PAPER_HORIZON, TASKS
from dual_system.tasks.kitchen.environment import KitchenEnvironment
from dual_system.tasks.kitchen.goals import GOAL_SETS
from dual_system.tasks.task import make_task, task_names
from protocol.messages import Robot
from sim_client.kitchen_robot import panda_omron
from sim_client.panda_robot import simulated_robot

World = Environment | KitchenEnvironment
SUITE, KITCHEN_SUITE = "RoboMME", "RoboCasa-DC"


def names() -> tuple[str, ...]:
    """Returns the tasks' names: the sixteen, the twenty-four and the goal sets."""
    return (*task_names(), *TASKS, *GOAL_SETS)


def require(task: str) -> None:
    """Raises TaskError if there is no such task."""
    if not _is_kitchen(task):
        make_task(task)


def open_world(task: str, *, render: bool, max_steps: int) -> World:
    """Returns an environment of a task. Kitchen episodes end after 1000 steps at the latest, as the paper's do."""
    if _is_kitchen(task):
        return KitchenEnvironment(task, render=render, max_steps=min(max_steps, PAPER_HORIZON))
    return make_environment(task, render=render, max_steps=max_steps)


def robot_of(world: World, first: Snapshot) -> Robot:
    """Returns the robot of an environment at its episode's first snapshot."""
    if isinstance(world, KitchenEnvironment):
        return panda_omron()
    return simulated_robot(world.physics.robot, first.state)


def suite_of(world: World) -> str:
    """Returns ``EpisodeInfo.suite``."""
    return KITCHEN_SUITE if isinstance(world, KitchenEnvironment) else SUITE


def _is_kitchen(task: str) -> bool:
    return task in TASKS or task in GOAL_SETS
