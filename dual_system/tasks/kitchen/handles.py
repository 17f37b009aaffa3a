"""Where scripts take hold of a bay: axes, handles, buttons and regions of the fixtures, as data in the world frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from dual_system.tasks.geometry import Array
from dual_system.tasks.kitchen.plan import BayPlan, Point


def point(xyz_m: ArrayLike) -> Point:
    """Returns three numbers as a point."""
    x_m, y_m, z_m = np.asarray(xyz_m, dtype=np.float64).tolist()
    return x_m, y_m, z_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Region:
    """A box along the world's axes."""

    center_m: Point
    half_m: Point


@dataclass(frozen=True, slots=True, kw_only=True)
class Hinge:
    """A leaf, lever or spout that turns about an axis. Grip, bar and normal are those at angle 0."""

    joint: str
    anchor_m: Point  # a point of the axis
    axis: Point  # unit; the angle is right-handed about it
    range_rad: tuple[float, float]
    open_rad: float  # the angle whose fraction is 1
    grip_m: Point  # middle of the handle
    bar: Point  # unit, along the handle
    normal: Point  # unit, out of the leaf: where a hand comes from

    def at(self, angle_rad: float) -> tuple[Array, Array, Array]:
        """Returns grip, bar and normal (3,) each at an angle."""
        rotation, quat = np.empty(9), np.empty(4)
        mujoco.mju_axisAngle2Quat(quat, np.array(self.axis), angle_rad)
        mujoco.mju_quat2Mat(rotation, quat)
        R = rotation.reshape(3, 3)
        anchor = np.array(self.anchor_m)
        return anchor + R @ (np.array(self.grip_m) - anchor), R @ np.array(self.bar), R @ np.array(self.normal)


@dataclass(frozen=True, slots=True, kw_only=True)
class Slide:
    """A drawer. Its joint's value is minus the travel: 0 is shut, ``-open_m`` is the fraction 1."""

    joint: str
    axis: Point  # unit, into the wall
    open_m: float
    grip_m: Point  # middle of the handle when it is shut
    bar: Point
    normal: Point

    def at(self, qpos_m: float) -> tuple[Array, Array, Array]:
        """Returns grip, bar and normal (3,) each at a joint value."""
        return np.array(self.grip_m) + qpos_m * np.array(self.axis), np.array(self.bar), np.array(self.normal)


@dataclass(frozen=True, slots=True, kw_only=True)
class Knob:
    """A stove's knob; 0 is off. What turns is a grip box (the blade) whose long side is ``blade`` at 0."""

    joint: str
    anchor_m: Point  # centre of the grip box, on the axis
    axis: Point  # unit, into the panel
    blade: Point
    normal: Point  # out of the panel
    half_m: Point  # of the grip box: across the blade, along the normal, along the blade


@dataclass(frozen=True, slots=True, kw_only=True)
class Button:
    """A button. It does not move; touching it is what counts."""

    geom: str
    center_m: Point
    normal: Point
    half_m: float  # from the centre to the face that is pressed


@dataclass(frozen=True, slots=True, kw_only=True)
class Cabinet:
    """A wall cabinet with one door or two, the left one first; objects stand on its bottom."""

    name: str
    doors: tuple[Hinge, ...]
    inside: Region


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawer:
    """The top drawer of a stack; the others do not open."""

    name: str
    slide: Slide
    inside: Region  # when it is shut


@dataclass(frozen=True, slots=True, kw_only=True)
class Sink:
    """A sink in the counter. The spout's grip is its tip; the handle is a lever that is lifted to let water run."""

    name: str
    basin: Region
    spout: Hinge
    handle: Hinge


@dataclass(frozen=True, slots=True, kw_only=True)
class Stove:
    """A stove with knobs in front; a burner's point is the middle of its top."""

    name: str
    knobs: Mapping[str, Knob]
    burners: Mapping[str, Point]


@dataclass(frozen=True, slots=True, kw_only=True)
class Microwave:
    """A microwave on the counter, its door hinged on the left and its buttons on the right."""

    name: str
    door: Hinge
    start: Button
    stop: Button
    inside: Region
    tray_m: Point  # middle of the tray's top


@dataclass(frozen=True, slots=True, kw_only=True)
class CoffeeMachine:
    """A coffee machine on the counter, its button on top."""

    name: str
    start: Button
    receptacle_m: Point  # where the mug's middle belongs


FixtureHandle = Cabinet | Drawer | Sink | Stove | Microwave | CoffeeMachine


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectHandle:
    """A free object: its body and joint have its name. Points and angles are in its own frame."""

    name: str
    kind: str
    half_m: Point  # of its bounding box
    grasp_m: Point  # where the fingers close
    grasp_width_m: float
    grasp_yaw_rad: float  # direction in which they close, about z from x
    radius_m: float  # of a container; 0 for others
    is_round: bool  # seen from above: fingers may close in any direction


@dataclass(frozen=True, slots=True, kw_only=True)
class Bay:
    """A built bay: its plan and its handles."""

    plan: BayPlan
    fixtures: Mapping[str, FixtureHandle]
    objects: Mapping[str, ObjectHandle]

    def start(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Puts joints and objects to where the plan has them, at rest. Call mj_forward after it."""
        for joint, value in self.plan.joints:
            data.qpos[model.joint(joint).qposadr[0]] = value
        for thing in self.plan.objects:
            first = int(model.joint(thing.name).qposadr[0])
            half_rad = thing.yaw_rad / 2
            data.qpos[first : first + 7] = [*thing.position_m, np.cos(half_rad), 0.0, 0.0, np.sin(half_rad)]
