"""How each of the twenty-four tasks is done: primitives applied to the handles of a goal's things.

A script is lazy: it reads where things are when it gets to them, and among the ways to do a thing (where the base
stands, how the hand is tilted, which finger is where) it takes the one that the arm reaches best. It leaves the hand
far from what it has touched.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from itertools import product

import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.kitchen import places, steps
from dual_system.tasks.kitchen.arm import Arm, Way
from dual_system.tasks.kitchen.doors import lead_doors
from dual_system.tasks.kitchen.handles import Button, CoffeeMachine, Drawer, Microwave, Sink, Stove
from dual_system.tasks.kitchen.pick_and_place import Manner, Place, pick_and_place
from dual_system.tasks.kitchen.plan import Goal, Target
from dual_system.tasks.kitchen.predicates import View
from dual_system.tasks.kitchen.pushing import push
from dual_system.tasks.kitchen.reach import Leg
from dual_system.tasks.kitchen.steps import AHEAD, UP, Steps

_LEVER_OUT_M = 0.13  # where a lever is pushed
_WATER_RAD, _NO_WATER_RAD = 0.50, 0.25
_SPOUT_RAD, _KNOB_RAD = 0.72, 0.75
_KNOB_ATTEMPTS, _KNOB_OFF_BY_RAD, _NUM_KNOB_WAYS = 3, 0.3, 6
_TILTS = tuple(np.deg2rad((0.0, 20.0, 40.0)))
_FORWARD_TILTS = tuple(np.deg2rad((50.0, 65.0)))  # into cabinets and microwaves
_MUG_TILTS = tuple(np.deg2rad((65.0, 80.0)))
_CARRY_M, _ENTER_M, _ENTER_MACHINE_M = 0.14, 0.38, 0.20


Script = Callable[[Arm, Target], Steps]


def script(goal: Goal, view: View) -> Steps:
    """Returns the steps that reach a goal. They raise UnreachableError where the arm cannot do the next thing."""
    return SCRIPTS[goal.task](Arm(view), goal.target)


def _drawer(arm: Arm, target: Target, *, fraction: float) -> Steps:
    drawer = arm.view.bay.fixtures[target.fixture]
    assert isinstance(drawer, Drawer)
    slide = drawer.slide
    now = arm.view.angle(slide.joint)
    there = -fraction * slide.open_m

    def frame(tilt: float, yaw: float) -> Array:
        grip, bar, _ = slide.at(now)
        direction = steps.tilted(steps.about(UP, np.deg2rad(yaw)) @ AHEAD, np.deg2rad(tilt))
        return steps.tool(grip, direction, np.cross(bar, direction))

    travel = (there - now) * np.array(slide.axis)
    ways = [
        Way(
            base=(back, 0.0),
            poses=(T, steps.moved(T, travel / 2), steps.moved(T, travel)),
            joint=slide.joint,
            values=(now, (now + there) / 2, there),
        )
        for back, tilt, yaw in product((0.0, -0.15), (65.0, 80.0), (0.0, -25.0, 25.0))
        for T in (frame(tilt, yaw), steps.flipped(frame(tilt, yaw)))
    ]
    (way,) = arm.best(ways)
    yield from arm.drive(way.base)
    yield from steps.grasp(way.poses[0], slide.joint)
    yield from steps.slide(slide, now, there, way.poses[0])
    yield from steps.release(steps.here(arm.view))
    yield from steps.retreat(arm.view, back_m=0.15)


def _faucet(arm: Arm, target: Target, *, to_rad: float) -> Steps:
    sink = _sink(arm, target)
    now = arm.view.angle(sink.handle.joint)
    anchor = np.array(sink.handle.anchor_m)
    _, along, above = sink.handle.at(now)
    side = -above if to_rad > now else above
    yield from push(arm, sink.handle, to_rad, anchor + _LEVER_OUT_M * along, from_side=side)


def _spout(arm: Arm, target: Target) -> Steps:
    sink = _sink(arm, target)
    to_rad = _SPOUT_RAD if target.part == "right" else -_SPOUT_RAD
    tip, _, _ = sink.spout.at(now := arm.view.angle(sink.spout.joint))
    outward = (tip - np.array(sink.spout.anchor_m)) * [1.0, 1.0, 0.0]
    ahead = np.cross(UP, outward / np.linalg.norm(outward)) * np.sign(to_rad - now)
    yield from push(arm, sink.spout, to_rad, tip - 0.012 * ahead, from_side=-ahead)


def _sink(arm: Arm, target: Target) -> Sink:
    sink = arm.view.bay.fixtures[target.fixture]
    assert isinstance(sink, Sink)
    return sink


def _turn_knob(arm: Arm, target: Target, *, is_on: bool) -> Steps:
    """Grasps the knob and turns the wrist; where that has not done, once more from another place of the base."""
    stove = arm.view.bay.fixtures[target.fixture]
    assert isinstance(stove, Stove)
    knob = stove.knobs[target.part]
    axis = np.array(knob.axis)
    bases = list(product((-0.2, -0.35, -0.5), (-0.2, 0.0, 0.2)))

    def frame(tilt: float, angle: float) -> Array:
        T = steps.tool(knob.anchor_m, steps.tilted(AHEAD, np.deg2rad(tilt)), np.cross(axis, knob.blade))
        T[:3, :3] = steps.about(axis, angle) @ T[:3, :3]
        return T

    for _ in range(_KNOB_ATTEMPTS):
        now = arm.view.angle(knob.joint)
        ends = (_KNOB_RAD, -_KNOB_RAD) if is_on else (0.0,)
        kinds = list(product(bases, (55.0, 70.0, 85.0), ends, (0.0, np.pi, -np.pi)))
        ways = [
            Way(base=base, poses=(frame(tilt, now + half_turn), frame(tilt, end + half_turn)))
            for base, tilt, end, half_turn in kinds
        ]
        best = arm.best(ways, _NUM_KNOB_WAYS)
        way = best[arm.first_free([Leg(base=each.base, poses=_to_and_from(each.poses))] for each in best)]
        end = next(kind[2] for kind, each in zip(kinds, ways, strict=True) if each is way)
        yield from arm.drive(way.base)
        yield from steps.grasp(way.poses[0], knob.joint)
        yield from steps.turn(knob, way.poses[0], now, end)
        yield from steps.release(steps.here(arm.view))
        yield from steps.retreat(arm.view, back_m=0.2)
        if abs(arm.view.angle(knob.joint) - end) < _KNOB_OFF_BY_RAD:
            return
        bases.remove(way.base)
        yield from arm.go_home()


def _to_and_from(poses: tuple[Array, ...]) -> tuple[Array, ...]:
    """Returns the path that grasps a knob at the first pose, turns it to the last one and draws back."""
    return steps.backed(poses[0], 0.1), *poses, steps.backed(poses[-1], 0.2)


def _microwave_button(arm: Arm, target: Target, *, name: str) -> Steps:
    microwave = arm.view.bay.fixtures[target.fixture]
    assert isinstance(microwave, Microwave)
    yield from _press(arm, getattr(microwave, name), (65.0, 80.0, 90.0), (0.0, 25.0, -25.0), (0.0, -0.2))


def _coffee_button(arm: Arm, target: Target) -> Steps:
    machine = arm.view.bay.fixtures[target.fixture]
    assert isinstance(machine, CoffeeMachine)
    yield from _press(arm, machine.start, (5.0, 20.0, 35.0), (0.0,), (0.0, -0.1))


def _press(
    arm: Arm, button: Button, tilts: tuple[float, ...], yaws: tuple[float, ...], backs: tuple[float, ...]
) -> Steps:
    ways = []
    for back, left, tilt, yaw in product(backs, (-0.2, 0.0, 0.2), tilts, yaws):
        direction = steps.tilted(steps.about(UP, np.deg2rad(yaw)) @ AHEAD, np.deg2rad(tilt))
        flat = np.cross(steps.about(UP, np.deg2rad(yaw)) @ AHEAD, UP)
        for closing in (flat, -flat, np.cross(flat, direction)):
            T = steps.tool(np.array(button.center_m) + button.half_m * np.array(button.normal), direction, closing)
            ways.append(Way(base=(back, left), poses=(steps.backed(T, 0.1), T)))
    (way,) = arm.best(ways)
    yield from arm.drive(way.base)
    yield from steps.press(way.poses[1])


_OVER, _INTO = _CARRY_M * UP, -_ENTER_M * AHEAD + 0.03 * UP
_INTO_MACHINE = -_ENTER_MACHINE_M * AHEAD + 0.03 * UP


def _carry(place: Place, tilts: tuple[float, ...], leave: Array, enter: Array) -> Script:
    return partial(pick_and_place, manner=Manner(place=place, tilts=tilts, leave=leave, enter=enter))


SCRIPTS: Mapping[str, Script] = {
    "PnPCounterToCab": _carry(places.in_fixture, _FORWARD_TILTS, leave=_OVER, enter=_INTO),
    "PnPCabToCounter": _carry(places.on_counter, _FORWARD_TILTS, leave=_INTO, enter=_OVER),
    "PnPCounterToSink": _carry(places.in_fixture, _TILTS, leave=_OVER, enter=0.25 * UP),
    "PnPSinkToCounter": _carry(places.in_container, _TILTS, leave=0.28 * UP, enter=_OVER),
    "PnPCounterToMicrowave": _carry(places.in_container, _FORWARD_TILTS, leave=_OVER, enter=_INTO),
    "PnPMicrowaveToCounter": _carry(places.in_container, _FORWARD_TILTS, leave=_INTO, enter=_OVER),
    "PnPCounterToStove": _carry(places.in_container, _TILTS, leave=_OVER, enter=_OVER),
    "PnPStoveToCounter": _carry(places.in_container, _TILTS, leave=_OVER, enter=_OVER),
    "OpenSingleDoor": partial(lead_doors, fraction=0.96),
    "CloseSingleDoor": partial(lead_doors, fraction=0.0),
    "OpenDoubleDoor": partial(lead_doors, fraction=0.96),
    "CloseDoubleDoor": partial(lead_doors, fraction=0.0),
    "OpenDrawer": partial(_drawer, fraction=1.05),
    "CloseDrawer": partial(_drawer, fraction=0.0),
    "TurnOnSinkFaucet": partial(_faucet, to_rad=_WATER_RAD),
    "TurnOffSinkFaucet": partial(_faucet, to_rad=_NO_WATER_RAD),
    "TurnSinkSpout": _spout,
    "TurnOnStove": partial(_turn_knob, is_on=True),
    "TurnOffStove": partial(_turn_knob, is_on=False),
    "TurnOnMicrowave": partial(_microwave_button, name="start"),
    "TurnOffMicrowave": partial(_microwave_button, name="stop"),
    "CoffeePressButton": _coffee_button,
    "CoffeeSetupMug": _carry(places.under_dispenser, _MUG_TILTS, leave=_OVER, enter=_INTO_MACHINE),
    "CoffeeServeMug": _carry(places.on_counter, _MUG_TILTS, leave=_INTO_MACHINE, enter=_OVER),
}
