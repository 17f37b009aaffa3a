"""Where an object is to be put: functions that return where its origin shall be, (3,) in metres."""

from __future__ import annotations

import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.kitchen.handles import CoffeeMachine
from dual_system.tasks.kitchen.plan import COUNTER_TOP_M, Target
from dual_system.tasks.kitchen.predicates import View, region_of
from dual_system.tasks.kitchen.steps import UP

_SPOT_ROOM_M = 0.16


def in_container(view: View, target: Target) -> Array:
    """On the floor of the container."""
    container = view.bay.objects[target.container]
    return view.position_m(target.container) + (half_height_m(view, target.obj) - container.half_m[2] + 0.02) * UP


def in_fixture(view: View, target: Target) -> Array:
    """On the floor of the fixture, in front of the middle."""
    region = region_of(view.bay, target.fixture)
    bottom = region.center_m[2] - region.half_m[2]
    x = float(np.clip(view.bay.plan.stand.x_m, region.center_m[0] - 0.1, region.center_m[0] + 0.1))
    y = region.center_m[1] - 0.3 * region.half_m[1]
    return np.array([x, y, bottom + half_height_m(view, target.obj) + 0.015])


def on_counter(view: View, target: Target) -> Array:
    """On a free spot of the counter in front of the robot."""
    stand = view.bay.plan.stand
    others = [view.position_m(name)[:2] for name in view.bay.objects if name != target.obj]
    spots = [np.array([stand.x_m + x, y]) for x in (0.0, -0.2, 0.2, -0.3, 0.3) for y in (-0.50, -0.42)]
    if isinstance(view.bay.fixtures.get(target.fixture), CoffeeMachine):
        spots = [spot for spot in spots if abs(spot[0] - stand.x_m) > 0.15]
    room = [min((float(np.linalg.norm(spot - other)) for other in others), default=1.0) for spot in spots]
    best = next(
        (spot for spot, each in zip(spots, room, strict=True) if each > _SPOT_ROOM_M), spots[int(np.argmax(room))]
    )
    return np.array([*best, COUNTER_TOP_M + half_height_m(view, target.obj) + 0.01])


def under_dispenser(view: View, target: Target) -> Array:
    """On the coffee machine's plate."""
    machine = view.bay.fixtures[target.fixture]
    assert isinstance(machine, CoffeeMachine)
    x, y, _ = machine.receptacle_m
    return np.array([x, y, COUNTER_TOP_M + 0.03 + half_height_m(view, target.obj) + 0.008])


def half_height_m(view: View, name: str) -> float:
    """Returns half the height of an object's bounding box, as the object lies."""
    R = view.data.body(name).xmat.reshape(3, 3)
    return float(np.abs(R[2]) @ view.bay.objects[name].half_m)
