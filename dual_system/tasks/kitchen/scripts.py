"""How each of the twenty-four tasks is done: primitives applied to the handles of a goal's things.

A script is lazy: it reads where things are when it gets to them, and among the ways to do a thing (where the base
stands, how the hand is tilted, which finger is where) it takes the one that the arm reaches best. It leaves the hand
far from what it has touched.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.kinematics import UnreachableError
from dual_system.tasks.kitchen import omron, steps
from dual_system.tasks.kitchen.handles import Button, Cabinet, CoffeeMachine, Drawer, Hinge, Microwave, Sink, Stove
from dual_system.tasks.kitchen.plan import COUNTER_TOP_M, Goal, Target
from dual_system.tasks.kitchen.predicates import View, hinges, region_of
from dual_system.tasks.kitchen.reach import UNREACHABLE, Base, Reach
from dual_system.tasks.kitchen.steps import AHEAD, SHUT, UP, Step, Steps

_BASES: tuple[Base, ...] = ((0.0, 0.0), (0.0, 0.2), (0.0, -0.2), (-0.15, 0.0), (-0.15, 0.2), (-0.15, -0.2), (-0.3, 0.0))
_STEEP_RAD = 0.8
_TURN_COST, _DRIVE_COST = 0.08, 0.3  # of worth, a radian and a metre: far turns may end at a joint's limit
_NUM_GRIPS = 4  # ways to hold an object that are followed to where it goes
_LEVER_OUT_M, _FINGER_M = 0.13, 0.016  # where a lever is pushed; from its middle to that of closed fingers
_WATER_RAD, _NO_WATER_RAD = 0.50, 0.25
_SPOUT_RAD, _KNOB_RAD = 0.72, 0.75
_KNOB_ATTEMPTS, _KNOB_OFF_BY_RAD = 3, 0.3
_LOW_M, _WIDE_RAD, _HALF_SHUT_RAD = 1.3, 0.8, 0.7  # doors: a low bar, wide open, where to take it anew to shut it
_AROUND_M = -0.17 * AHEAD  # around the edge of an open leaf
_EASY = 0.1  # worth of a way that needs no second go
_TILTS = tuple(np.deg2rad((0.0, 20.0, 40.0)))
_FORWARD_TILTS = tuple(np.deg2rad((50.0, 65.0)))  # into cabinets and microwaves
_MUG_TILTS = tuple(np.deg2rad((65.0, 80.0)))
_CARRY_M, _ENTER_M = 0.14, 0.38


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """One way to do something: where the base stands, and the poses (4, 4) that the tool comes through."""

    base: Base
    poses: tuple[Array, ...]
    joint: str = ""  # what the tool leads on the way
    values: tuple[float, ...] = ()  # of it, one a pose
    cost: float = 0.0  # taken off its worth


class Arm:
    """What scripts know of the robot: where its tool is, and which way of several it reaches best."""

    def __init__(self, view: View) -> None:
        self.view = view
        self._reach = Reach(view)
        self._home, self._home_base = steps.here(view), self._reach.base()

    def rate(self, ways: Sequence[Way], start: Array = omron.START_QPOS) -> tuple[float, int, Array]:
        """Returns how well the best of some ways is reached, which it is, and the joints (7,) at its end."""
        rated = [
            self._reach.worth(way.poses, way.base, joint=way.joint, values=way.values, start=start) for way in ways
        ]
        best = int(np.argmax([worth - way.cost for (worth, _), way in zip(rated, ways, strict=True)]))
        return rated[best][0], best, rated[best][1]

    def best(self, ways: Sequence[Way]) -> Way:
        """Returns the way that is reached best. Raises UnreachableError if none is."""
        worth, best, _ = self.rate(ways)
        if worth <= UNREACHABLE:
            raise UnreachableError(f"none of {len(ways)} ways is within the arm's reach; draw another scene")
        return ways[best]

    def go_home(self) -> Steps:
        """Brings the hand back to where it was at first, seen from the base."""
        (ahead, left), (ahead_0, left_0) = self._reach.base(), self._home_base
        home = steps.moved(self._home, [left_0 - left, ahead - ahead_0, 0.0])
        here = steps.here(self.view)
        nearer_m = min(0.0, float(here[1, 3] - home[1, 3]))  # to the robot: open doors are ahead
        turned = [steps.rotated_about_itself(home, turn) for turn in (0.0, np.pi, np.pi / 2, -np.pi / 2)]
        turned.append(steps.moved(here, home[:3, 3] - here[:3, 3]))  # or as it is
        ways = [Way(base=self._reach.base(), poses=(steps.moved(T, nearer_m * AHEAD), T)) for T in turned]
        _, best, _ = self.rate(ways, self._reach.joints())
        for T in ways[best].poses:
            yield Step(pose=T)

    def drive(self, base: Base, *, holds: str = "") -> Steps:
        """Moves the base to a place if it is not there; the hand rides along."""
        now = self._reach.base()
        if max(abs(a - b) for a, b in zip(now, base, strict=True)) > 0.02:
            shift = np.array([now[1] - base[1], base[0] - now[0], 0.0])
            yield Step(pose=steps.moved(steps.here(self.view), shift), base_m=base, opening=SHUT, holds=holds)


Script = Callable[[Arm, Target], Steps]


def script(goal: Goal, view: View) -> Steps:
    """Returns the steps that reach a goal. They raise UnreachableError where the arm cannot do the next thing."""
    return SCRIPTS[goal.task](Arm(view), goal.target)


def _doors(arm: Arm, target: Target, *, fraction: float) -> Steps:
    for i, door in enumerate(hinges(arm.view.bay, target.fixture)):
        if i:
            yield from arm.go_home()
        yield from _lead_door(arm, door, fraction * door.open_rad)


def _lead_door(arm: Arm, door: Hinge, to_rad: float) -> Steps:
    """Takes a door by its bar and leads it along its arc, in two goes if need be; the base makes room."""
    grasps = _door_grasps(door)
    now = arm.view.angle(door.joint)
    is_shutting = abs(now) > abs(to_rad)

    def way(grasp: _DoorGrasp, start_rad: float, end_rad: float) -> Way:
        span = np.linspace(start_rad, end_rad, 4).tolist()
        poses = tuple(grasp.at(door, angle) for angle in span)
        before = steps.backed(poses[0], 0.1)
        if abs(start_rad) > _WIDE_RAD and is_shutting:  # the open leaf is between the hand and its bar
            before = steps.moved(before, _AROUND_M)
        return Way(base=grasp.base, poses=(before, *poses), joint=door.joint, values=(start_rad, *span))

    worth, best, _ = arm.rate([way(grasp, now, to_rad) for grasp in grasps])
    ends = [to_rad] if worth > _EASY or not is_shutting else [_HALF_SHUT_RAD * np.sign(now), to_rad]
    for i, end in enumerate(ends):
        if i:
            yield from arm.go_home()
            now = arm.view.angle(door.joint)
        _, best, _ = arm.rate([way(grasp, now, end) for grasp in grasps])
        grasp = grasps[best]
        yield from arm.drive(grasp.base)
        now = arm.view.angle(door.joint)  # the arm may have touched it
        before, frame, *_ = way(grasp, now, end).poses
        yield Step(pose=before)
        yield from steps.grasp(frame, door.joint)
        yield from steps.swing(door, now, end, frame, follow=grasp.follow)
        yield from steps.release(steps.here(arm.view))
        yield from steps.retreat(arm.view, back_m=0.1)
        if abs(end) > _WIDE_RAD:
            yield Step(pose=steps.moved(steps.here(arm.view), _AROUND_M))


@dataclass(frozen=True, slots=True, kw_only=True)
class _DoorGrasp:
    """How a door's bar is held: where the base stands, and how the hand turns with the leaf."""

    base: Base
    tilt_rad: float
    follow: float
    is_flipped: bool

    def at(self, door: Hinge, angle_rad: float) -> Array:
        """Returns the tool's pose (4, 4) at an angle of the door."""
        grip, bar, _ = door.at(angle_rad)
        toward = steps.about(UP, self.follow * angle_rad) @ AHEAD
        T = steps.tool(grip, steps.tilted(toward, self.tilt_rad), np.cross(bar, toward))
        return steps.flipped(T) if self.is_flipped else T


def _door_grasps(door: Hinge) -> list[_DoorGrasp]:
    side = -float(np.sign(door.open_rad))
    lefts: tuple[float, ...]
    if door.grip_m[2] < _LOW_M:  # a microwave's, whose door is wide as well
        backs, lefts, tilts, follows = (-0.3, -0.4), (-0.1, 0.05), (35.0, 50.0), (0.15, 0.5)
    else:
        backs, lefts, tilts, follows = (-0.15, -0.25), (-0.1, 0.05, 0.2, 0.35), (60.0, 75.0), (0.0, 0.2)
    return [
        _DoorGrasp(base=(back, left * side), tilt_rad=float(np.deg2rad(tilt)), follow=follow, is_flipped=flip)
        for back, left, tilt, follow, flip in product(backs, lefts, tilts, follows, (False, True))
    ]


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
    way = arm.best(ways)
    yield from arm.drive(way.base)
    yield from steps.grasp(way.poses[0], slide.joint)
    yield from steps.slide(slide, now, there, way.poses[0])
    yield from steps.release(steps.here(arm.view))
    yield from steps.retreat(arm.view, back_m=0.15)


def _push(arm: Arm, hinge: Hinge, to_rad: float, contact_m: Array, *, from_side: Array) -> Steps:
    """Pushes a lever or a spout along its arc with closed fingers, from one side of it, at a point of it."""
    now = arm.view.angle(hinge.joint)
    anchor, axis = np.array(hinge.anchor_m), np.array(hinge.axis)
    start = contact_m + _FINGER_M * from_side

    def at(angle_rad: float, T: Array) -> Array:
        there = T.copy()
        there[:3, 3] = anchor + steps.about(axis, angle_rad - now) @ (T[:3, 3] - anchor)
        return there

    ways = []
    for back, left, tilt, yaw in product((0.0, -0.15), (-0.2, 0.0, 0.2), (60.0, 85.0), (-30.0, 0.0, 30.0)):
        direction = steps.tilted(steps.about(UP, np.deg2rad(yaw)) @ AHEAD, np.deg2rad(tilt))
        flat = np.cross(direction, UP)
        for closing in (flat, np.cross(flat, direction)):
            T = steps.tool(start, direction, closing)
            ways.append(Way(base=(back, left), poses=(steps.moved(T, 0.03 * from_side), T, at(to_rad, T))))
    way = arm.best(ways)
    yield from arm.drive(way.base)
    before, T, _ = way.poses
    yield Step(pose=steps.backed(before, 0.12), opening=SHUT)
    yield Step(pose=before, opening=SHUT)
    yield Step(pose=T, opening=SHUT, speed_m_s=0.1)
    for angle in np.linspace(now, to_rad, 7)[1:]:
        yield Step(pose=at(angle, T), opening=SHUT, speed_m_s=0.08, holds=hinge.joint, value=float(angle))
    yield Step(pose=at(to_rad, T), opening=SHUT, wait_steps=20, holds=hinge.joint, value=to_rad)
    yield from steps.retreat(arm.view, opening=SHUT)


def _faucet(arm: Arm, target: Target, *, to_rad: float) -> Steps:
    sink = _sink(arm, target)
    now = arm.view.angle(sink.handle.joint)
    anchor = np.array(sink.handle.anchor_m)
    _, along, above = sink.handle.at(now)
    side = -above if to_rad > now else above
    yield from _push(arm, sink.handle, to_rad, anchor + _LEVER_OUT_M * along, from_side=side)


def _spout(arm: Arm, target: Target) -> Steps:
    sink = _sink(arm, target)
    to_rad = _SPOUT_RAD if target.part == "right" else -_SPOUT_RAD
    tip, _, _ = sink.spout.at(now := arm.view.angle(sink.spout.joint))
    outward = (tip - np.array(sink.spout.anchor_m)) * [1.0, 1.0, 0.0]
    ahead = np.cross(UP, outward / np.linalg.norm(outward)) * np.sign(to_rad - now)
    yield from _push(arm, sink.spout, to_rad, tip - 0.012 * ahead, from_side=-ahead)


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
    bases = list(product((-0.2, -0.35), (-0.2, 0.0, 0.2)))

    def frame(tilt: float, angle: float) -> Array:
        T = steps.tool(knob.anchor_m, steps.tilted(AHEAD, np.deg2rad(tilt)), np.cross(axis, knob.blade))
        T[:3, :3] = steps.about(axis, angle) @ T[:3, :3]
        return T

    for _ in range(_KNOB_ATTEMPTS):
        now = arm.view.angle(knob.joint)
        ends = (_KNOB_RAD, -_KNOB_RAD) if is_on else (0.0,)
        kinds = list(product(bases, (70.0, 85.0), ends, (0.0, np.pi, -np.pi)))
        ways = [
            Way(base=base, poses=(frame(tilt, now + half_turn), frame(tilt, end + half_turn)))
            for base, tilt, end, half_turn in kinds
        ]
        way = arm.best(ways)
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
    way = arm.best(ways)
    yield from arm.drive(way.base)
    yield from steps.press(way.poses[1])


def _pick_and_place(
    arm: Arm,
    target: Target,
    *,
    place: Callable[[Arm, Target], Array],
    tilts: tuple[float, ...],
    leave: Array,
    enter: Array,
    bases: tuple[Base, ...] = _BASES,
) -> Steps:
    """Grasps the object, draws it out along ``leave``, carries it to the end of ``enter`` and lets go of it there.

    Args:
        place: where the object's origin shall be.
        tilts: of the hand; it keeps its own from picking to placing, so that the object stays upright.
        leave: from where the object stands to where it is free [m].
        enter: from where it is free to where it shall be, reversed [m].
    """
    view, thing = arm.view, arm.view.bay.objects[target.obj]
    goal, now = place(arm, target), view.position_m(target.obj)
    grips = []
    for tilt in tilts:
        round_ways = (tilt, -tilt) if tilt < _STEEP_RAD else (tilt,)  # a flat hand comes from the robot's side
        grips += [T for each in round_ways for T in steps.grips_on(view, thing, each)]
    has_walls = isinstance(view.bay.fixtures.get(target.fixture), Cabinet | Microwave)
    grips = [
        T for grip in grips for T in (grip, steps.flipped(grip)) if not (has_walls and leave[1]) or _points_ahead(T)
    ]

    def placed(T: Array, yaw: float) -> Array:
        turned = steps.about(UP, yaw)
        there = T.copy()
        there[:3, :3], there[:3, 3] = turned @ T[:3, :3], goal + turned @ (T[:3, 3] - now)
        return there

    picks = [
        [
            Way(base=base, poses=(steps.moved(T, leave), steps.backed(T, 0.1), T, steps.moved(T, leave)))
            for base in bases
        ]
        for T in grips
    ]
    rated = sorted(((*arm.rate(ways), i) for i, ways in enumerate(picks)), key=lambda each: -each[0])
    plans: list[tuple[float, int, Way, Way]] = []
    for worth, best, qpos, i in rated[:_NUM_GRIPS]:
        out, base_0 = steps.moved(grips[i], leave), picks[i][best].base
        ways = []
        for yaw, base in product(np.linspace(-np.pi, np.pi, 8, endpoint=False), bases):
            there = placed(grips[i], yaw)
            if (has_walls and enter[1] and not _points_ahead(there)) or (leave[1] and base[0] > base_0[0]):
                continue  # it would reach along a wall, or drive into what it has just come out of
            before = steps.moved(there, enter)
            cost = _TURN_COST * abs(yaw) + _DRIVE_COST * float(np.hypot(base[0] - base_0[0], base[1] - base_0[1]))
            ways.append(Way(base=base, poses=(*steps.between(out, before), before, there), cost=cost))
        if ways:
            worth_there, best_there, _ = arm.rate(ways, qpos)
            plans.append((min(worth, worth_there), len(plans), picks[i][best], ways[best_there]))
    if not plans or max(plans)[0] <= UNREACHABLE:
        raise UnreachableError(f"none of {len(grips)} ways to hold the {thing.kind} leads there; draw another scene")
    _, _, pick, put = max(plans)
    (out, _, grip, _), (*_, before, there) = pick.poses, put.poses
    yield from arm.drive(pick.base)
    yield Step(pose=out, opening=steps.OPEN)
    yield from steps.grasp(grip, target.obj)
    yield Step(pose=steps.moved(grip, 0.03 * UP), opening=SHUT, holds=target.obj, speed_m_s=0.15)
    yield Step(pose=out, opening=SHUT, holds=target.obj, speed_m_s=0.2)
    yield from arm.drive(put.base, holds=target.obj)
    yield Step(pose=before, opening=SHUT, holds=target.obj, speed_m_s=0.2)
    yield Step(pose=there, opening=SHUT, holds=target.obj, speed_m_s=0.12)
    yield from steps.release(steps.here(view))
    yield from steps.retreat(view)
    yield Step(pose=steps.backed(before, 0.1))
    yield from arm.go_home()


def _points_ahead(T: Array) -> bool:
    """Returns whether a tool points into a fixture rather than along it."""
    flat = T[:2, 2] / max(float(np.linalg.norm(T[:2, 2])), 1e-6)
    return bool(flat[1] > 0.7)


def _in_container(arm: Arm, target: Target) -> Array:
    """On the floor of the container."""
    container, thing = arm.view.bay.objects[target.container], arm.view.bay.objects[target.obj]
    return arm.view.position_m(target.container) + (thing.half_m[2] - container.half_m[2] + 0.02) * UP


def _in_fixture(arm: Arm, target: Target) -> Array:
    """On the floor of the fixture, in front of the middle."""
    region = region_of(arm.view.bay, target.fixture)
    bottom = region.center_m[2] - region.half_m[2]
    x = float(np.clip(arm.view.bay.plan.stand.x_m, region.center_m[0] - 0.1, region.center_m[0] + 0.1))
    y = region.center_m[1] - 0.3 * region.half_m[1]
    return np.array([x, y, bottom + arm.view.bay.objects[target.obj].half_m[2] + 0.015])


def _on_counter(arm: Arm, target: Target) -> Array:
    """On a free spot of the counter in front of the robot."""
    stand, half_z = arm.view.bay.plan.stand, arm.view.bay.objects[target.obj].half_m[2]
    others = [arm.view.position_m(name)[:2] for name in arm.view.bay.objects if name != target.obj]
    spots = [np.array([stand.x_m + x, y]) for x in (0.0, -0.2, 0.2, -0.3, 0.3) for y in (-0.50, -0.42)]
    if isinstance(arm.view.bay.fixtures.get(target.fixture), CoffeeMachine):
        spots = [spot for spot in spots if abs(spot[0] - stand.x_m) > 0.15]
    room = [min((float(np.linalg.norm(spot - other)) for other in others), default=1.0) for spot in spots]
    best = next((spot for spot, each in zip(spots, room, strict=True) if each > 0.16), spots[int(np.argmax(room))])
    return np.array([*best, COUNTER_TOP_M + half_z + 0.01])


def _under_dispenser(arm: Arm, target: Target) -> Array:
    machine, half_z = arm.view.bay.fixtures[target.fixture], arm.view.bay.objects[target.obj].half_m[2]
    assert isinstance(machine, CoffeeMachine)
    x, y, _ = machine.receptacle_m
    return np.array([x, y, COUNTER_TOP_M + 0.03 + half_z + 0.008])


_OVER, _INTO = _CARRY_M * UP, -_ENTER_M * AHEAD + 0.03 * UP

SCRIPTS: Mapping[str, Script] = {
    "PnPCounterToCab": partial(_pick_and_place, place=_in_fixture, tilts=_FORWARD_TILTS, leave=_OVER, enter=_INTO),
    "PnPCabToCounter": partial(_pick_and_place, place=_on_counter, tilts=_FORWARD_TILTS, leave=_INTO, enter=_OVER),
    "PnPCounterToSink": partial(_pick_and_place, place=_in_fixture, tilts=_TILTS, leave=_OVER, enter=0.25 * UP),
    "PnPSinkToCounter": partial(_pick_and_place, place=_in_container, tilts=_TILTS, leave=0.28 * UP, enter=_OVER),
    "PnPCounterToMicrowave": partial(
        _pick_and_place, place=_in_container, tilts=_FORWARD_TILTS, leave=_OVER, enter=_INTO
    ),
    "PnPMicrowaveToCounter": partial(
        _pick_and_place, place=_in_container, tilts=_FORWARD_TILTS, leave=_INTO, enter=_OVER
    ),
    "PnPCounterToStove": partial(_pick_and_place, place=_in_container, tilts=_TILTS, leave=_OVER, enter=_OVER),
    "PnPStoveToCounter": partial(_pick_and_place, place=_in_container, tilts=_TILTS, leave=_OVER, enter=_OVER),
    "OpenSingleDoor": partial(_doors, fraction=0.96),
    "CloseSingleDoor": partial(_doors, fraction=0.0),
    "OpenDoubleDoor": partial(_doors, fraction=0.96),
    "CloseDoubleDoor": partial(_doors, fraction=0.0),
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
    "CoffeeSetupMug": partial(_pick_and_place, place=_under_dispenser, tilts=_MUG_TILTS, leave=_OVER, enter=_INTO),
    "CoffeeServeMug": partial(_pick_and_place, place=_on_counter, tilts=_MUG_TILTS, leave=_INTO, enter=_OVER),
}
