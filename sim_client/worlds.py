"""Environments by a task's name, the sixteen's or the kitchen's: all that episodes ask of either."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

from dual_system.tasks import disguises
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.kinematics import UnreachableError
from dual_system.tasks.kitchen.catalogue import PAPER_HORIZON, TASKS
from dual_system.tasks.kitchen.disguises import KINDS
from dual_system.tasks.kitchen.environment import KitchenEnvironment
from dual_system.tasks.kitchen.goals import GOAL_SETS, twin_of
from dual_system.tasks.task import TaskError, chosen_tasks, make_task, task_names
from protocol.messages import Robot
from sim_client.kitchen_robot import panda_omron
from sim_client.panda_robot import simulated_robot

World = Environment | KitchenEnvironment
SUITE, KITCHEN_SUITE = "RoboMME", "RoboCasa-DC"
Pictures = Literal["own", "other-scene", "without-cue", "retold", "last-frame"]


def names() -> tuple[str, ...]:
    """Returns the tasks' names: the sixteen, the twenty-four and the goal sets."""
    return (*task_names(), *TASKS, *GOAL_SETS)


def chosen(tasks: Sequence[str]) -> tuple[str, ...]:
    """Returns the tasks of ``--tasks``, sorted, each once; "all" stands for the sixteen.

    Raises TaskError for an unknown one, or for tasks of both suites, which have no mean.
    """
    kitchen = {name for name in tasks if _is_kitchen(name)}
    if not kitchen:
        return chosen_tasks(tasks)
    if others := [name for name in tasks if name not in kitchen]:
        raise TaskError(f"{min(kitchen)} is the kitchen's and {others[0]!r} is not: evaluate each suite by itself")
    return tuple(sorted(kitchen))


def require(task: str, pictures: Pictures = "own") -> None:
    """Raises TaskError if there is no such task, or if it has no such pictures."""
    if not _is_kitchen(task):
        make_task(task)
    is_one_goal = pictures == "retold" and task in TASKS
    known = KINDS if _is_kitchen(task) else get_args(disguises.Pictures)
    if pictures not in known or is_one_goal:
        usable = [name for name in known if not (is_one_goal and name == pictures)]
        raise TaskError(f"{task} has no --pictures {pictures}; it has {', '.join(usable)}")


def open_world(task: str, *, render: bool, max_steps: int, pictures: Pictures = "own") -> World:
    """Returns an environment of a task that shows the given pictures. Raises TaskError as `require` does."""
    require(task, pictures)
    if _is_kitchen(task):
        return KINDS[pictures](task, render=render, max_steps=limit(task, max_steps))
    assert pictures != "last-frame"
    return disguises.disguised(task, pictures, render=render, max_steps=max_steps)


def limit(task: str, max_steps: int) -> int:
    """Returns when a task's episodes end: kitchen episodes after 1000 steps at the latest, as the paper's do."""
    return min(max_steps, PAPER_HORIZON) if _is_kitchen(task) else max_steps


def robot_of(world: World, first: Snapshot) -> Robot:
    """Returns the robot of an environment at its episode's first snapshot."""
    if isinstance(world, KitchenEnvironment):
        return panda_omron()
    return simulated_robot(world.physics.robot, first.state)


def suite_of(world: World) -> str:
    """Returns ``EpisodeInfo.suite``."""
    return KITCHEN_SUITE if isinstance(world, KitchenEnvironment) else SUITE


def why_unpaired(world: World) -> str:
    """Returns why this scene has no demonstration although its task has, or "": it has, or its task has none.

    It is the same however the demonstration is shown, so that conditions are played in the same scenes.
    """
    if isinstance(world, KitchenEnvironment):
        try:
            world.rehearse()
        except UnreachableError as error:
            return str(error)
    return ""


def goals_of(world: World) -> dict[str, Any]:
    """Returns a kitchen episode's goals: the seed's own, its twin, the one that was done or None, and their number."""
    if not isinstance(world, KitchenEnvironment):
        return {}
    twin = twin_of(world.name, world.scene.seed) if world.name in GOAL_SETS else None
    found = {"own": world.own_goal, "twin": twin, "done": world.goal_done, "of": len(world.scene.goals)}
    return {"goals": found}


def _is_kitchen(task: str) -> bool:
    return task in TASKS or task in GOAL_SETS
