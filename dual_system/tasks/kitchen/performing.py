"""Steps of a script as actions of the PandaOmron, each computed from where the hand is when it is asked for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from dual_system.tasks.geometry import Array, rotation_log
from dual_system.tasks.kitchen import omron
from dual_system.tasks.kitchen.control import CONTROL_HZ, POSITION_M, ROTATION_RAD, rotation_of
from dual_system.tasks.kitchen.layout import ACTION, NUM_ACTION
from dual_system.tasks.kitchen.steps import Step, here
from dual_system.tasks.kitchen.world import World

_TURN_RAD_S = 1.2
_NEAR_M, _NEAR_RAD = 0.008, 0.08  # a step is done that near to its end
_PATIENCE = 15  # control steps that the hand may lag behind its schedule before the next step begins
_DRIVEN_M, _MAX_DRIVE = 0.01, 80
_DRIVE_M_S, _DRIVE_GAIN = 0.35, 4.0
_FRICTION_M_S = 0.25  # of the velocity that the base is told, its friction swallows this much


def perform(world: World, steps: Iterable[Step]) -> Iterator[Array]:
    """Yields the actions (12,) that follow the steps; advance the world by each before the next is taken."""
    for step in steps:
        if step.base_m is not None:
            yield from _drive(world, step, np.array(step.base_m))
        else:
            yield from _move(world, step)


def _move(world: World, step: Step) -> Iterator[Array]:
    """Leads the hand along a straight line at the step's speed while it turns evenly, then waits."""
    start = here(world.view)
    turn = rotation_log(step.pose[:3, :3] @ start[:3, :3].T)
    way = step.pose[:3, 3] - start[:3, 3]
    seconds = max(float(np.linalg.norm(way)) / step.speed_m_s, float(np.linalg.norm(turn)) / _TURN_RAD_S)
    num = max(1, int(np.ceil(seconds * CONTROL_HZ)))
    for k in range(1, num + _PATIENCE + 1):
        share = min(1.0, k / num)
        target = np.eye(4)
        target[:3, 3] = start[:3, 3] + share * way
        target[:3, :3] = rotation_of(share * turn) @ start[:3, :3]
        yield _towards(world, target, step.opening)
        if k >= num and _is_near(here(world.view), step.pose):
            break
    for _ in range(step.wait_steps):
        yield _towards(world, step.pose, step.opening)


def _towards(world: World, target: Array, opening: float) -> Array:
    """Returns the action that pulls the hand towards a pose (4, 4)."""
    hand = here(world.view)
    base = world.data.site(omron.ARM_SITE).xmat.reshape(3, 3)
    action = _rest(opening)
    action[ACTION["arm_position"]] = base.T @ (target[:3, 3] - hand[:3, 3]) / POSITION_M
    action[ACTION["arm_rotation"]] = base.T @ rotation_log(target[:3, :3] @ hand[:3, :3].T) / ROTATION_RAD
    return np.clip(action, -1.0, 1.0)


def _drive(world: World, step: Step, target_m: Array) -> Iterator[Array]:
    """Drives the base to a place, ahead and left of its stand; the hand rides along."""
    for _ in range(_MAX_DRIVE):
        away_m = target_m - [world.data.joint(name).qpos[0] for name in omron.BASE_JOINTS[:2]]
        if np.abs(away_m).max() < _DRIVEN_M:
            break
        speed = _DRIVE_GAIN * away_m
        speed *= min(1.0, _DRIVE_M_S / np.abs(speed).max())  # both ways at once: along a straight line
        action = _rest(step.opening)
        action[ACTION["base_velocity"]] = [*(speed + _FRICTION_M_S * np.sign(speed)), 0.0]
        action[ACTION["mode"]] = 1.0
        yield action


def _rest(opening: float) -> Array:
    action = np.zeros(NUM_ACTION)
    action[ACTION["gripper"]] = -1.0 if opening > 0.5 else 1.0
    action[ACTION["mode"]] = -1.0
    return action


def _is_near(hand: Array, target: Array) -> bool:
    turn = rotation_log(target[:3, :3] @ hand[:3, :3].T)
    return bool(np.linalg.norm(target[:3, 3] - hand[:3, 3]) < _NEAR_M and np.linalg.norm(turn) < _NEAR_RAD)
