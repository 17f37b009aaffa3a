"""Free objects of a bay: nineteen kinds from primitives, each with three training instances (A) and three held out (B).

Everything that is to be picked up is convex and at most 68 mm wide where the fingers close. A body's origin is the
centre of its bounding box.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dual_system.tasks.kitchen.handles import ObjectHandle
from dual_system.tasks.kitchen.parts import Part, Workshop
from dual_system.tasks.kitchen.plan import Instances, ObjectPlan, Point

NUM_INSTANCES = 3  # of each split
# Rolling friction stops round things; a mass of 30 to 250 g is light enough for the gripper.
FLOOR_M = 0.008  # thickness of a container's floor
_RIM_M, _SIDES = 0.005, 10  # of a container's wall: half its thickness, and the boxes it is made of
_FROM_TOP_M = 0.025  # where an upright thing is grasped
_FREE: dict[str, Any] = {"condim": 6, "friction": [1.0, 0.01, 0.002], "density": 400.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class Instance:
    """One instance of a kind: its size in millimetres, with its shape's meaning, and its colours."""

    size_mm: tuple[float, ...]
    looks: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """A kind of object: how it is built, and its instances, A first."""

    shape: str
    instances: tuple[Instance, ...]
    is_food: bool = True  # may lie on plates and in pans
    is_washable: bool = False


Grasp = tuple[Point, float, float]
"""Where the fingers close in the body's frame, how wide it is there, and in which direction (about z from x)."""


def _kind(shape: str, sizes: tuple[tuple[float, ...], ...], looks: tuple[tuple[str, ...], ...], **flags: bool) -> Kind:
    made = tuple(Instance(size_mm=size, looks=look) for size, look in zip(sizes, looks, strict=True))
    return Kind(shape=shape, instances=made, **flags)


_EACH = 2 * NUM_INSTANCES
KINDS: dict[str, Kind] = {
    # ball: half axes x, y, z
    "apple": _kind("ball", ((33, 33, 33), (30, 30, 30), (32, 32, 32), (31, 31, 31), (33, 33, 33), (29, 29, 29)),
                   (("red",), ("lime",), ("dark red",), ("yellow",), ("green",), ("red",)), is_washable=True),
    "orange": _kind("ball", ((32, 32, 32), (30, 30, 30), (33, 33, 33), (31, 31, 31), (29, 29, 29), (28, 28, 28)),
                    (("orange",),) * _EACH, is_washable=True),
    "tomato": _kind("ball", ((30, 30, 25), (32, 32, 27), (28, 28, 24), (31, 31, 24), (29, 29, 26), (33, 33, 28)),
                    (("red",), ("red",), ("orange",), ("dark red",), ("red",), ("lime",)), is_washable=True),
    "lemon": _kind("ball", ((36, 26, 26), (38, 27, 27), (34, 25, 25), (37, 25, 25), (33, 27, 27), (39, 26, 26)),
                   (("yellow",), ("lime",), ("yellow",), ("yellow",), ("lime",), ("green",)), is_washable=True),
    "potato": _kind("ball", ((44, 28, 25), (40, 30, 26), (48, 29, 24), (42, 27, 27), (46, 31, 26), (38, 28, 24)),
                    (("tan",), ("brown",), ("tan",), ("crust",), ("tan",), ("brown",)), is_washable=True),
    "onion": _kind("ball", ((30, 30, 28), (32, 32, 29), (28, 28, 27), (31, 31, 26), (29, 29, 29), (33, 33, 30)),
                   (("purple",), ("cream",), ("crust",), ("pink",), ("purple",), ("cream",)), is_washable=True),
    # block: half sides x, y, z, and a band's look
    "cucumber": _kind("block", ((85, 20, 20), (75, 21, 20), (90, 19, 19), (80, 22, 21), (70, 20, 20), (88, 21, 20)),
                      (("dark green", "green"), ("green", "lime"), ("dark green", "lime")) * 2, is_washable=True),
    "carrot": _kind("block", ((80, 16, 15), (70, 17, 16), (75, 15, 15), (65, 16, 16), (85, 17, 15), (72, 18, 16)),
                    (("orange", "green"),) * _EACH, is_washable=True),
    "bread": _kind("block", ((52, 32, 26), (60, 30, 28), (48, 33, 25), (56, 31, 30), (50, 29, 27), (64, 33, 26)),
                   (("crust", "tan"), ("brown", "crust"), ("tan", "cream")) * 2),
    "chocolate": _kind("block", ((60, 28, 17), (55, 30, 18), (65, 26, 17), (50, 32, 18), (58, 27, 19), (62, 31, 17)),
                       (("brown", "red"), ("navy", "silver"), ("purple", "white"),
                        ("dark green", "cream"), ("brown", "yellow"), ("dark red", "white"))),
    "cheese": _kind("block", ((40, 28, 24), (45, 30, 22), (36, 26, 26), (42, 32, 24), (38, 27, 21), (48, 29, 25)),
                    (("yellow", "orange"), ("cream", "yellow"), ("orange", "red")) * 2),
    "sponge": _kind("block", ((50, 32, 18), (45, 30, 20), (55, 31, 17), (48, 28, 19), (52, 33, 16), (42, 30, 18)),
                    (("yellow", "green"), ("pink", "purple"), ("blue", "navy")) * 2, is_food=False, is_washable=True),
    # post: radius, half height, and of a neck that is part of it radius and half height
    "can": _kind("post", ((31, 45), (32, 50), (30, 40), (32, 42), (28, 52), (31, 48)),
                 (("red", "silver"), ("green", "silver"), ("blue", "silver"),
                  ("orange", "silver"), ("teal", "silver"), ("purple", "silver")), is_food=False),
    "jar": _kind("post", ((32, 44, 29, 8), (30, 48, 28, 8), (33, 43, 30, 9),
                          (31, 46, 30, 8), (33, 50, 28, 8), (29, 45, 27, 9)),
                 (("crust", "white"), ("dark red", "gray"), ("lime", "white"),
                  ("purple", "yellow"), ("orange", "white"), ("cream", "red")), is_food=False),
    "bottle": _kind("post", ((30, 85, 13, 22), (28, 90, 12, 25), (31, 80, 14, 24),
                             (29, 88, 13, 20), (32, 86, 12, 26), (27, 82, 13, 22)),
                    (("green", "white"), ("blue", "white"), ("dark red", "cream"),
                     ("teal", "yellow"), ("brown", "white"), ("red", "white")), is_food=False),
    # containers: inner radius, half height
    "plate": _kind("plate", ((85, 8), (90, 9), (80, 8), (88, 9), (82, 8), (92, 9)),
                   (("white", "cream"), ("blue", "white"), ("cream", "tan"),
                    ("teal", "white"), ("pink", "white"), ("yellow", "cream")), is_food=False),
    "bowl": _kind("bowl", ((72, 27), (78, 30), (68, 26), (75, 29), (70, 25), (80, 28)),
                  (("white", "cream"), ("red", "white"), ("navy", "blue"),
                   ("green", "lime"), ("purple", "pink"), ("orange", "cream")), is_food=False),
    "pan": _kind("pan", ((85, 20), (92, 22), (80, 20), (88, 21), (82, 23), (95, 20)),
                 (("black", "iron"), ("iron", "gray"), ("dark red", "iron"),
                  ("navy", "iron"), ("gray", "silver"), ("dark green", "iron")), is_food=False),
    "mug": _kind("mug", ((32, 45), (31, 48), (33, 42), (32, 50), (30, 46), (33, 44)),
                 (("white", "brown"), ("blue", "brown"), ("red", "brown"),
                  ("green", "brown"), ("yellow", "brown"), ("purple", "brown")), is_food=False),
}  # fmt: skip
FOODS = tuple(name for name, kind in KINDS.items() if kind.is_food)
_VESSEL_ROOM_MM = 65
DISHES = tuple(name for name in FOODS if max(each.size_mm[0] for each in KINDS[name].instances) <= _VESSEL_ROOM_MM)
"""Food that lies within a plate or a pan."""
WASHABLES = tuple(name for name, kind in KINDS.items() if kind.is_washable)
GRASPABLES = tuple(name for name, kind in KINDS.items() if kind.shape in ("ball", "block", "post"))


def instances_of(split: Instances) -> range:
    """Returns the numbers of a split's instances; they are the same for every kind."""
    return range(NUM_INSTANCES) if split == "A" else range(NUM_INSTANCES, 2 * NUM_INSTANCES)


def half_of(kind: str, instance: int) -> Point:
    """Returns the half sides of an instance's bounding box."""
    size = [each / 1000.0 for each in KINDS[kind].instances[instance].size_mm]
    match KINDS[kind].shape:
        case "ball" | "block":
            return size[0], size[1], size[2]
        case "post" | "mug":
            return size[0], size[0], size[1]
        case _:
            outer = size[0] + 2 * _RIM_M
            return outer, outer, size[1]


def radius_of(kind: str, instance: int) -> float:
    """Returns a container's radius, by which predicates measure; 0 for other kinds."""
    is_container = KINDS[kind].shape in ("plate", "bowl", "pan")
    return KINDS[kind].instances[instance].size_mm[0] / 1000.0 if is_container else 0.0


def add_object(workshop: Workshop, plan: ObjectPlan) -> ObjectHandle:
    """Adds a free object where the plan has it."""
    kind = KINDS[plan.kind]
    made = kind.instances[plan.instance]
    part = workshop.free(plan.name, plan.position_m, plan.yaw_rad)
    grasp_m, width_m, yaw_rad = _SHAPES[kind.shape](part, [each / 1000.0 for each in made.size_mm], made.looks)
    return ObjectHandle(
        name=plan.name,
        kind=plan.kind,
        half_m=half_of(plan.kind, plan.instance),
        grasp_m=grasp_m,
        grasp_width_m=width_m,
        grasp_yaw_rad=yaw_rad,
        radius_m=radius_of(plan.kind, plan.instance),
        is_round=kind.shape == "post" or (kind.shape == "ball" and made.size_mm[0] == made.size_mm[1]),
    )


def _ball(part: Part, size: Sequence[float], looks: Sequence[str]) -> Grasp:
    part.ellipsoid((0.0, 0.0, 0.0), size, looks[0], **_FREE)
    part.cylinder((0.0, 0.0, size[2]), 0.003, 0.006, "brown", is_solid=False)
    return (0.0, 0.0, 0.0), 2 * size[1], np.pi / 2


def _block(part: Part, size: Sequence[float], looks: Sequence[str]) -> Grasp:
    part.box((0.0, 0.0, 0.0), size, looks[0], **_FREE)
    band = (size[0] * 0.45, size[1] + 0.0006, size[2] + 0.0006)
    part.box((0.0, 0.0, 0.0), band, looks[1], is_solid=False)
    return (0.0, 0.0, 0.4 * size[2]), 2 * size[1], np.pi / 2  # fingertips stay clear of what it lies on


def _post(part: Part, size: Sequence[float], looks: Sequence[str]) -> Grasp:
    radius, high, neck_radius, neck_half = (*size, 0.0, 0.0)[:4]
    body_half = high - neck_half
    part.cylinder((0.0, 0.0, body_half - high), radius, body_half, looks[0], **_FREE)
    part.cylinder((0.0, 0.0, body_half - high), radius + 0.0006, body_half * 0.45, looks[1], is_solid=False)
    if neck_half:
        part.cylinder((0.0, 0.0, high - neck_half), neck_radius, neck_half, looks[1], **_FREE)
    return (0.0, 0.0, high - _FROM_TOP_M), 2 * (neck_radius or radius), 0.0


def _plate(part: Part, size: Sequence[float], looks: Sequence[str]) -> Grasp:
    return _vessel(part, size, looks, mass_kg=0.35)


def _bowl(part: Part, size: Sequence[float], looks: Sequence[str]) -> Grasp:
    return _vessel(part, size, looks, mass_kg=0.35)


def _pan(part: Part, size: Sequence[float], looks: Sequence[str]) -> Grasp:
    reach = size[0] + 2 * _RIM_M + 0.07
    part.box((reach, 0.0, size[1] - 0.008), (0.075, 0.011, 0.007), looks[1], **(_FREE | {"density": 300.0}))
    return _vessel(part, size, looks, mass_kg=0.9)


def _vessel(part: Part, size: Sequence[float], looks: Sequence[str], *, mass_kg: float) -> Grasp:
    """Adds a floor, which has the weight, and a wall around it."""
    radius, high = size
    floor_half_m = FLOOR_M / 2
    solid: dict[str, Any] = {"condim": 4, "friction": [1.0, 0.01, 0.002], "mass": mass_kg}
    part.cylinder((0.0, 0.0, floor_half_m - high), radius + _RIM_M, floor_half_m, looks[1], **solid)
    part.ring((0.0, 0.0, floor_half_m), radius, (_RIM_M, high - floor_half_m), looks[0], num=_SIDES)
    return (radius + _RIM_M, 0.0, high), 2 * _RIM_M, 0.0


def _mug(part: Part, size: Sequence[float], looks: Sequence[str]) -> Grasp:
    radius, high = size
    part.cylinder((0.0, 0.0, 0.0), radius, high, looks[0], **_FREE)
    part.cylinder((0.0, 0.0, high), radius - 0.004, 0.0006, looks[1], is_solid=False)
    for z in (-0.02, 0.02):
        part.box((radius + 0.012, 0.0, z), (0.014, 0.005, 0.005), looks[0], is_solid=False)
    part.box((radius + 0.024, 0.0, 0.0), (0.005, 0.005, 0.025), looks[0], **_FREE)
    return (0.0, 0.0, 0.0), 2 * radius, np.pi / 2


_SHAPES: dict[str, Callable[[Part, Sequence[float], Sequence[str]], Grasp]] = {
    "ball": _ball,
    "block": _block,
    "post": _post,
    "plate": _plate,
    "bowl": _bowl,
    "pan": _pan,
    "mug": _mug,
}
