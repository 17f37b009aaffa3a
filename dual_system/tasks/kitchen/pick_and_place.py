"""Picking an object up and putting it elsewhere, and once more where that has failed.

The ways to hold it, to put it and to stand are rated by their ends; the first of the best whose whole path touches
nothing is taken. If it can, the hand moves sideways only at the robot's side, away from fixtures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.kinematics import UnreachableError
from dual_system.tasks.kitchen import steps
from dual_system.tasks.kitchen.arm import Arm, Way
from dual_system.tasks.kitchen.grips import grips_on
from dual_system.tasks.kitchen.handles import Cabinet, Microwave
from dual_system.tasks.kitchen.plan import Target
from dual_system.tasks.kitchen.predicates import View
from dual_system.tasks.kitchen.reach import UNREACHABLE, Base, Leg
from dual_system.tasks.kitchen.steps import SHUT, UP, Step, Steps

_BASES: tuple[Base, ...] = ((0.0, 0.0), (0.0, 0.2), (0.0, -0.2), *product((-0.15, -0.3), (0.0, 0.2, -0.2)))
_STEEP_RAD = 0.8
_TURN_COST, _DRIVE_COST = 0.08, 0.3  # of worth, a radian and a metre: far turns may end at a joint's limit
_NUM_STANDS, _NUM_PICKS, _NUM_PUTS = 2, 8, 3  # to hold it one way from; to pick it in all; to put each pick
_NUM_PLANS = 24  # whose paths are followed at most
_ATTEMPTS = 3
_BACK_M, _LIFT_M = 0.1, 0.03
_SLIPPED_M, _MISPLACED_M = 0.04, 0.05  # in the hand, and from where it should be


Place = Callable[[View, Target], Array]
"""Where an object's origin shall be, (3,) in metres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Manner:
    """How a task's object is held and carried."""

    place: Place
    tilts: tuple[float, ...]
    """The hand's [rad]: one is kept from picking to placing, so that the object stays upright."""
    leave: Array
    """From where the object stands to where it is free [m]."""
    enter: Array
    """From where it is free to where it shall be, reversed [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Plan:
    """One way to hold an object, to put it, and to stand for both."""

    worth: float
    pick_base: Base
    put_base: Base
    out: Array  # the hand (4, 4) where the object, once picked, is free
    grip: Array
    before: Array  # the hand where the object is about to be put
    there: Array
    backed: Array  # the hand once it has let go and drawn back
    away: Array  # the hand where it is free of the object and of what that was put into
    comes_around: bool = True  # the hand goes sideways near the robot only, rather than straight
    carries_around: bool = True  # so it does with the object

    def to_grip(self, start: Array) -> list[Array]:
        """Returns the hand's poses from a start to where it is about to approach the object."""
        return [*(steps.around(start, self.out) if self.comes_around else []), self.out]

    def to_place(self, start: Array) -> list[Array]:
        """Returns the hand's poses from a start to where it is about to put the object."""
        return [*(steps.around(start, self.before) if self.carries_around else []), self.before]


def pick_and_place(arm: Arm, target: Target, *, manner: Manner) -> Steps:
    """Yields the steps of picking and placing, from another side where the object has not come to its place."""
    tried: list[Array] = []
    for _ in range(_ATTEMPTS):
        plan = _best(arm, target, manner, tried)
        tried.append(plan.grip)
        yield from _perform(arm, target, plan)
        yield from arm.go_home()
        away_m = arm.view.position_m(target.obj) - manner.place(arm.view, target)
        if float(np.linalg.norm(away_m[:2])) < _MISPLACED_M:
            return


def _perform(arm: Arm, target: Target, plan: _Plan) -> Steps:
    """Yields the steps of one plan; it ends early where the object is not in the hand."""
    view, obj = arm.view, target.obj
    yield from arm.drive(plan.pick_base)
    for T in plan.to_grip(steps.here(view)):
        yield Step(pose=T)
    yield from steps.grasp(plan.grip, obj)
    held = _in_hand(view, obj)
    yield Step(pose=steps.moved(plan.grip, _LIFT_M * UP), opening=SHUT, holds=obj, speed_m_s=0.15)
    yield Step(pose=plan.out, opening=SHUT, holds=obj, speed_m_s=0.2)
    if float(np.linalg.norm(_in_hand(view, obj) - held)) > _SLIPPED_M:
        return
    yield from arm.drive(plan.put_base, holds=obj)
    for T in plan.to_place(steps.here(view)):
        yield Step(pose=T, opening=SHUT, holds=obj, speed_m_s=0.2)
    if float(np.linalg.norm(_in_hand(view, obj) - held)) > _SLIPPED_M:
        return
    yield Step(pose=plan.there, opening=SHUT, holds=obj, speed_m_s=0.12)
    yield from steps.release(steps.here(view))
    yield Step(pose=plan.backed, speed_m_s=0.2)
    yield Step(pose=plan.away)


def _in_hand(view: View, obj: str) -> Array:
    """Returns where an object is in the hand's frame (3,)."""
    T = steps.here(view)
    return T[:3, :3].T @ (view.position_m(obj) - T[:3, 3])


def _legs(arm: Arm, target: Target, plan: _Plan) -> list[Leg]:
    """Returns the path of a plan from where the hand is."""
    start = arm.after_drive(steps.here(arm.view), plan.pick_base)
    lifted = steps.moved(plan.grip, _LIFT_M * UP)
    out = arm.after_drive(plan.out, plan.put_base, plan.pick_base)
    return [
        Leg(base=plan.pick_base, poses=(*plan.to_grip(start), steps.backed(plan.grip, _BACK_M), plan.grip)),
        Leg(base=plan.pick_base, poses=(lifted, plan.out), carries=target.obj),
        Leg(base=plan.put_base, poses=(*plan.to_place(out), plan.there), carries=target.obj),
        Leg(base=plan.put_base, poses=(plan.backed, plan.away)),
    ]


def _best(arm: Arm, target: Target, manner: Manner, tried: list[Array]) -> _Plan:
    """Returns the plan to follow. Raises UnreachableError if nothing leads there."""
    plans = _plans(arm, target, manner)
    if not plans:
        kind = arm.view.bay.objects[target.obj].kind
        raise UnreachableError(f"no way to hold the {kind} leads to where it shall be; draw another scene")
    fresh = [plan for plan in plans if not any(np.allclose(plan.grip, T, atol=0.02) for T in tried)] or plans
    best = sorted(fresh, key=lambda plan: -plan.worth)[:_NUM_PLANS]
    ranked = [
        replace(plan, comes_around=comes, carries_around=carries)
        for plan, carries, comes in product(best, (True, False), (True, False))
    ]
    return ranked[arm.first_free(_legs(arm, target, plan) for plan in ranked)]


def _plans(arm: Arm, target: Target, manner: Manner) -> list[_Plan]:
    """Returns plans within reach, rated by how well the ends of their parts are reached."""
    view, leave, enter = arm.view, manner.leave, manner.enter
    goal, now = manner.place(view, target), view.position_m(target.obj)
    grips = _grips(view, target, manner)
    picks = []
    for T in grips:
        out = steps.moved(T, leave)
        ways = [Way(base=base, poses=(out, steps.backed(T, _BACK_M), T, out)) for base in _BASES]
        picks += [(worth, ways[i].base, T, qpos) for worth, i, qpos in arm.rate_best(ways, _NUM_STANDS)]
    picks.sort(key=lambda each: -each[0])
    plans = []
    for worth, pick_base, grip, qpos in picks[:_NUM_PICKS]:
        out, ways = steps.moved(grip, leave), []
        for yaw, base in product(np.linspace(-np.pi, np.pi, 8, endpoint=False), _BASES):
            there = _placed(grip, goal, now, yaw)
            if (_has_walls(view, target) and enter[1] and not _points_ahead(there)) or (
                leave[1] and base[0] > pick_base[0]
            ):
                continue  # it would reach along a wall, or drive into what it has just come out of
            before = steps.moved(there, enter)
            cost = _TURN_COST * abs(yaw) + _DRIVE_COST * float(np.hypot(*np.subtract(base, pick_base)))
            ways.append(Way(base=base, poses=(*steps.between(out, before), before, there), cost=cost))
        for put_worth, i, _ in arm.rate_best(ways, _NUM_PUTS, qpos):
            if min(worth, put_worth) <= UNREACHABLE:
                continue
            *_, before, there = ways[i].poses
            backed = steps.backed(there, _BACK_M)
            plans.append(
                _Plan(
                    worth=min(worth, put_worth - ways[i].cost),
                    pick_base=pick_base,
                    put_base=ways[i].base,
                    out=out,
                    grip=grip,
                    before=before,
                    there=there,
                    backed=backed,
                    away=steps.moved(backed, enter) if enter[1] else before,  # not across the object
                )
            )
    return plans


def _grips(view: View, target: Target, manner: Manner) -> list[Array]:
    """Returns the hand's poses that hold the object, with either finger in front."""
    thing = view.bay.objects[target.obj]
    grips = []
    for tilt in manner.tilts:
        round_ways = (tilt, -tilt) if tilt < _STEEP_RAD else (tilt,)  # a flat hand comes from the robot's side
        grips += [T for each in round_ways for T in grips_on(view, thing, each)]
    is_inside = _has_walls(view, target) and bool(manner.leave[1])
    return [T for grip in grips for T in (grip, steps.flipped(grip)) if not is_inside or _points_ahead(T)]


def _placed(grip: Array, goal: Array, now: Array, yaw_rad: float) -> Array:
    """Returns the hand's pose with the object at the goal, turned about the vertical by an angle."""
    turned = steps.about(UP, yaw_rad)
    there = grip.copy()
    there[:3, :3], there[:3, 3] = turned @ grip[:3, :3], goal + turned @ (grip[:3, 3] - now)
    return there


def _has_walls(view: View, target: Target) -> bool:
    return isinstance(view.bay.fixtures.get(target.fixture), Cabinet | Microwave)


def _points_ahead(T: Array) -> bool:
    """Returns whether a tool points into a fixture rather than along it."""
    flat = T[:2, 2] / max(float(np.linalg.norm(T[:2, 2])), 1e-6)
    return bool(flat[1] > 0.7)
