"""Success: what can be measured in a bay, one function a kind, and which goal's checks hold.

A check is a band on one measured quantity (`plan.Check`); a goal is several of them at once. What must be remembered,
whether the microwave and the coffee machine run, is a frozen memory that is renewed each control step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.kitchen.fixtures.counter import COUNTER
from dual_system.tasks.kitchen.handles import (
    Bay,
    Button,
    Cabinet,
    CoffeeMachine,
    Drawer,
    Hinge,
    Microwave,
    Region,
    Sink,
)
from dual_system.tasks.kitchen.plan import Check, Goal

GRIP_SITE, HAND = "grip_site", "right_hand"
AJAR = 0.005  # a microwave's door that is open further stops it


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """What runs. Buttons switch it, and opening the microwave's door."""

    is_microwave_on: bool = False
    is_coffee_on: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """A bay's simulation as predicates read it. The robot has a site `grip_site` and a body `right_hand`."""

    model: mujoco.MjModel
    data: mujoco.MjData
    bay: Bay
    gripper: frozenset[int]  # geoms
    geoms: Mapping[str, frozenset[int]]  # of each fixture and object, of the counter, and of each button

    @classmethod
    def of(cls, model: mujoco.MjModel, data: mujoco.MjData, bay: Bay) -> View:
        """Returns the view of a compiled bay with a robot in it."""
        bodies = [COUNTER, *bay.fixtures, *bay.objects]
        geoms = {name: geoms_below(model, name) for name in bodies}
        geoms |= {button.geom: frozenset({model.geom(button.geom).id}) for button in _buttons(bay)}
        return cls(model=model, data=data, bay=bay, gripper=geoms_below(model, HAND), geoms=geoms)

    def angle(self, joint: str) -> float:
        """Returns a joint's value: rad, or m for a drawer."""
        return float(self.data.qpos[self.model.joint(joint).qposadr[0]])

    def position_m(self, name: str) -> Array:
        """Returns where an object, a button or a coffee machine's place for the mug is."""
        if name in self.bay.objects:
            return self.data.xpos[self.model.body(name).id].copy()
        fixture = self.bay.fixtures.get(name)
        if isinstance(fixture, CoffeeMachine):
            return np.array(fixture.receptacle_m)
        return self.data.geom_xpos[self.model.geom(name).id].copy()

    def touches(self, some: frozenset[int], others: frozenset[int]) -> bool:
        """Returns whether any of some geoms is in contact with any of others."""
        pairs = self.data.contact.geom[: self.data.ncon]
        return any((a in some and b in others) or (b in some and a in others) for a, b in pairs.tolist())


def geoms_below(model: mujoco.MjModel, body: str) -> frozenset[int]:
    """Returns the geoms of a body and of all bodies that hang on it."""
    below = {model.body(body).id}
    for each in range(model.nbody):  # parents come before their children
        if int(model.body_parentid[each]) in below:
            below.add(each)
    return frozenset(np.flatnonzero(np.isin(model.geom_bodyid, list(below))).tolist())


def remember(view: View, memory: Memory | None) -> Memory:
    """Returns the memory after one more control step; ``memory`` is None at the first observation."""
    before = memory or Memory(is_microwave_on=view.bay.plan.is_microwave_on)
    is_microwave_on, is_coffee_on = before.is_microwave_on, before.is_coffee_on
    for fixture in view.bay.fixtures.values():
        if isinstance(fixture, Microwave):
            button = fixture.stop if is_microwave_on else fixture.start
            is_pressed = view.touches(view.gripper, view.geoms[button.geom])
            is_shut = _fraction(view, fixture.door) < AJAR
            is_microwave_on = is_shut and (is_microwave_on != is_pressed)
        elif isinstance(fixture, CoffeeMachine):
            is_coffee_on = is_coffee_on or view.touches(view.gripper, view.geoms[fixture.start.geom])
    return Memory(is_microwave_on=is_microwave_on, is_coffee_on=is_coffee_on)


def fired(view: View, memory: Memory, goals: Sequence[Goal]) -> int | None:
    """Returns the first goal all of whose checks hold now, or None."""
    return next((i for i, goal in enumerate(goals) if all(holds(view, memory, check) for check in goal.checks)), None)


def holds(view: View, memory: Memory, check: Check) -> bool:
    """Returns whether everything that a check measures lies within its band, both ends included."""
    return all(check.low <= value <= check.high for value in KINDS[check.kind](view, memory, check))


def _doors(view: View, memory: Memory, check: Check) -> list[float]:
    """Fraction of 90 degrees by which a door (a joint) or each of a fixture's doors is open."""
    return [_fraction(view, door) for door in hinges(view.bay, check.of)]


def _drawer(view: View, memory: Memory, check: Check) -> list[float]:
    """Fraction of 0.55 times its depth by which a drawer is open."""
    drawer = view.bay.fixtures[check.of]
    assert isinstance(drawer, Drawer)
    return [-view.angle(drawer.slide.joint) / drawer.slide.open_m]


def _angle(view: View, memory: Memory, check: Check) -> list[float]:
    """Angle of a joint, as it is [rad]."""
    return [view.angle(check.of)]


def _turned(view: View, memory: Memory, check: Check) -> list[float]:
    """Angle of a joint within (-pi, pi] [rad]; positive is to the right for a spout."""
    return [_wrapped(view.angle(check.of))]


def _turned_by(view: View, memory: Memory, check: Check) -> list[float]:
    """How far a knob is turned from 0, either way, within [0, pi] [rad]."""
    return [abs(_wrapped(view.angle(check.of)))]


def _far(view: View, memory: Memory, check: Check) -> list[float]:
    """Distance of the gripper's site from an object or a button [m]."""
    return [_distance(view.data.site(GRIP_SITE).xpos, view.position_m(check.of))]


def _touches(view: View, memory: Memory, check: Check) -> list[float]:
    """1 if two things touch, else 0."""
    return [float(view.touches(view.geoms[check.of], view.geoms[check.to]))]


def _inside(view: View, memory: Memory, check: Check) -> list[float]:
    """Least distance of the corners of an object's box from the faces of a fixture's inner box [m]; inside is > 0."""
    half = np.array(view.bay.objects[check.of].half_m)
    R = view.data.xmat[view.model.body(check.of).id].reshape(3, 3)
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return [_depth(region_of(view.bay, check.to), view.position_m(check.of) + (signs * half) @ R.T)]


def _centre_inside(view: View, memory: Memory, check: Check) -> list[float]:
    """Least distance of an object's centre from the faces of a fixture's inner box [m]; inside is > 0."""
    return [_depth(region_of(view.bay, check.to), view.position_m(check.of)[None])]


def _radii(view: View, memory: Memory, check: Check) -> list[float]:
    """Horizontal distance of an object from a container's middle, in radii of the container."""
    return [_apart_xy(view, memory, check)[0] / view.bay.objects[check.to].radius_m]


def _apart_xy(view: View, memory: Memory, check: Check) -> list[float]:
    """Horizontal distance of two things [m]."""
    return [_distance(view.position_m(check.of)[:2], view.position_m(check.to)[:2])]


def _apart_z(view: View, memory: Memory, check: Check) -> list[float]:
    """Vertical distance of two things [m]."""
    return [abs(float(view.position_m(check.of)[2] - view.position_m(check.to)[2]))]


def _runs(view: View, memory: Memory, check: Check) -> list[float]:
    """1 if a microwave or a coffee machine runs, else 0."""
    is_microwave = isinstance(view.bay.fixtures[check.of], Microwave)
    return [float(memory.is_microwave_on if is_microwave else memory.is_coffee_on)]


KINDS: Mapping[str, Callable[[View, Memory, Check], list[float]]] = {
    "door": _doors,
    "drawer": _drawer,
    "angle": _angle,
    "turned": _turned,
    "turned_by": _turned_by,
    "far": _far,
    "touches": _touches,
    "inside": _inside,
    "centre_inside": _centre_inside,
    "radii": _radii,
    "apart_xy": _apart_xy,
    "apart_z": _apart_z,
    "runs": _runs,
}


def region_of(bay: Bay, name: str) -> Region:
    """Returns the inner box of a fixture. Raises TypeError for one that has none."""
    fixture = bay.fixtures[name]
    match fixture:
        case Cabinet() | Drawer() | Microwave():
            return fixture.inside
        case Sink():
            return fixture.basin
        case _:
            raise TypeError(f"{name!r} is a {type(fixture).__name__}, which has no inside")


def hinges(bay: Bay, name: str) -> tuple[Hinge, ...]:
    """The doors of a fixture, or the one whose joint has this name."""
    fixture = bay.fixtures[name.split("/")[0]]
    match fixture:
        case Cabinet():
            doors = fixture.doors
        case Microwave():
            doors = (fixture.door,)
        case _:
            raise TypeError(f"{name!r} is of a {type(fixture).__name__}, which has no doors")
    return tuple(door for door in doors if name in (fixture.name, door.joint))


def _buttons(bay: Bay) -> list[Button]:
    buttons: list[Button] = []
    for fixture in bay.fixtures.values():
        if isinstance(fixture, Microwave):
            buttons += [fixture.start, fixture.stop]
        elif isinstance(fixture, CoffeeMachine):
            buttons.append(fixture.start)
    return buttons


def _fraction(view: View, door: Hinge) -> float:
    return view.angle(door.joint) / door.open_rad


def _wrapped(angle_rad: float) -> float:
    return float(np.pi - (np.pi - angle_rad) % (2 * np.pi))


def _distance(a: Array, b: Array) -> float:
    return float(np.linalg.norm(np.subtract(a, b)))


def _depth(region: Region, points: Array) -> float:
    return float((np.array(region.half_m) - np.abs(points - np.array(region.center_m))).min())
