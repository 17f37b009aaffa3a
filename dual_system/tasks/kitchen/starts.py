"""How episodes start, one function a family: the drawn bay, what the goal is about, and words of the instruction.

Source: RoboCasa's kitchen tasks at v0.2, rules restated.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from dual_system.tasks.kitchen import objects
from dual_system.tasks.kitchen.drafts import Draft, Span, draft
from dual_system.tasks.kitchen.fixtures import cabinet, coffee_machine, counter, drawer, microwave, sink, stove
from dual_system.tasks.kitchen.plan import COUNTER_TOP_M, FixtureKind, Instances, Target

AJAR_FRACTION = (0.90, 1.0)  # of a door or drawer that starts open
_FRONT_Y_M: Span = (-0.57, -0.36)  # where objects to be picked stand on the counter
_BACK_Y_M: Span = (-0.22, -0.08)  # where distractors stand
_ASIDE_Y_M: Span = (-0.50, -0.10)  # both, beside a fixture
_UNDER_CABINET_X_M = 0.28
_DRAWER_ASIDE_M = counter.DRAWER_HALF_M + 0.3
DRAWER_BACK_M = 0.23
_PAN_YAW_RAD = (np.deg2rad(22.5), np.deg2rad(45.0))  # of the handle, to either side of the robot's direction
_MUG_YAW_RAD, _SERVED_YAW_RAD = np.deg2rad((45.0, 90.0)), np.deg2rad((22.5, 45.0))
_INSIDE_YAW_RAD = 0.6  # of what lies in a fixture or a container: fingers come from the robot's side
_WATER_ON_RAD, _KNOB_ON_RAD = (0.40, 0.50), (0.50, np.pi / 2)
SPOUT_START_RAD = 0.25
OBJ, CONTAINER = "obj", "container"


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """A drawn start: the bay, and of one goal in it the things and the words of its instruction."""

    draft: Draft
    target: Target
    words: dict[str, str] = field(default_factory=dict)


def open_joint(kind: FixtureKind, joint: str, fraction: float, *, opens_right: bool = False) -> float:
    """Returns the value of a door's or drawer's joint at a fraction."""
    if kind == "drawer":
        return -fraction * drawer.OPEN_M
    to_right = opens_right if kind == "cabinet" else joint.endswith("right_door")
    return fraction * (np.pi / 2 if to_right else -np.pi / 2)


def doors(rng: np.random.Generator, instances: Instances, *, is_open: bool, num: int) -> Start:
    """A cabinet, or for a single door perhaps a microwave, with its doors shut or open."""
    kind: FixtureKind = "double_cabinet" if num == 2 else ("cabinet", "microwave")[int(rng.integers(2))]
    name = "microwave" if kind == "microwave" else "cabinet"
    drawn = draft(rng, instances, [kind], names=[name])
    joints = [f"{name}/left_door", f"{name}/right_door"] if num == 2 else [f"{name}/door"]
    if is_open:
        open_doors(drawn, kind, joints)
    if kind == "microwave":
        _put_beside(drawn, microwave.HALF_WIDTH_M, int(rng.integers(1, 4)))
    else:
        reach = cabinet.HALF_WIDTH_M[kind] - 0.12
        floor = cabinet.BOTTOM_M + cabinet.WALL_M
        span = (drawn.x_m - reach, drawn.x_m + reach)
        drawn.put_somewhere("inside", drawn.draw_kind(objects.GRASPABLES), span, (-0.2, -0.1), z_m=floor)
        drawn.distract(int(rng.integers(1, 4)), [(drawn.x_m - 0.45, drawn.x_m + 0.45)], _ASIDE_Y_M)
    return Start(draft=drawn, target=Target(fixture=name), words={"fixture": name})


def open_doors(drawn: Draft, kind: FixtureKind, joints: list[str]) -> None:
    """Starts doors of the reference fixture open."""
    for joint in joints:
        fraction = float(drawn.rng.uniform(*AJAR_FRACTION))
        drawn.joints[joint] = open_joint(kind, joint, fraction, opens_right=drawn.fixtures[0].opens_right)


def drawers(rng: np.random.Generator, instances: Instances, *, is_open: bool) -> Start:
    """A drawer to the left or right of the robot, with an object in it."""
    side = int(rng.choice([-1, 1]))
    drawn = draft(rng, instances, ["drawer"], offsets_m=[side * _DRAWER_ASIDE_M], back_m=DRAWER_BACK_M)
    out_m = 0.0
    if is_open:
        drawn.joints["drawer/slide"] = open_joint("drawer", "", float(rng.uniform(*AJAR_FRACTION)))
        out_m = drawn.joints["drawer/slide"]
    put_in_drawer(drawn, "inside", drawn.fixtures[0].x_m, out_m)
    middle = drawn.fixtures[0].x_m
    drawn.distract(int(rng.integers(1, 4)), [(middle - 0.3, middle + 0.3)], _ASIDE_Y_M)
    word = "right" if side > 0 else "left"
    return Start(draft=drawn, target=Target(fixture="drawer"), words={"side": word})


def put_in_drawer(drawn: Draft, name: str, x_m: float, out_m: float) -> None:
    """Puts a low object into a drawer that is out by minus ``out_m``."""
    floor = COUNTER_TOP_M - counter.SLAB_M - 0.2 + 0.003 + 0.018
    y = counter.FRONT_Y_M + out_m + float(drawn.rng.uniform(0.12, 0.25))
    kind = drawn.draw_kind([each for each in objects.GRASPABLES if objects.KINDS[each].shape != "post"])
    x = x_m + float(drawn.rng.uniform(-0.1, 0.1))
    drawn.put(name, kind, (x, y, floor), yaw_rad=float(drawn.rng.uniform(-np.pi, np.pi)))


def faucet(rng: np.random.Generator, instances: Instances, *, is_on: bool) -> Start:
    """A sink whose lever is down, or up with the water on."""
    drawn = draft(rng, instances, ["sink"])
    if is_on:
        drawn.joints["sink/handle"] = float(rng.uniform(*_WATER_ON_RAD))
    _fill_sink(drawn)
    return Start(draft=drawn, target=Target(fixture="sink"))


def spout(rng: np.random.Generator, instances: Instances) -> Start:
    """A sink whose spout points about ahead; side and water are drawn."""
    start = faucet(rng, instances, is_on=bool(rng.integers(2)))
    start.draft.joints["sink/spout"] = float(rng.uniform(-SPOUT_START_RAD, SPOUT_START_RAD))
    side = ("left", "right")[int(rng.integers(2))]
    return Start(draft=start.draft, target=Target(fixture="sink", part=side), words={"side": side})


def _fill_sink(drawn: Draft) -> None:
    bottom = COUNTER_TOP_M - 0.158
    x, y = (drawn.x_m - 0.2, drawn.x_m + 0.2), (sink.CENTER_Y_M - 0.15, sink.CENTER_Y_M + 0.1)
    drawn.put_somewhere("inside", drawn.draw_kind(objects.WASHABLES), x, y, z_m=bottom)
    _put_beside(drawn, sink.HALF_WIDTH_M, int(drawn.rng.integers(1, 4)))


def knob(rng: np.random.Generator, instances: Instances, *, is_on: bool) -> Start:
    """A stove with one burner in question; cookware stands on it or, as often, on another."""
    drawn = draft(rng, instances, ["stove"])
    names = list(stove.KNOBS)
    asked = names[int(rng.integers(len(names)))]
    others = [name for name in names if name != asked]
    put_pan(drawn, asked if rng.random() < 0.5 else others[int(rng.integers(len(others)))])
    if is_on:
        drawn.joints[f"stove/{asked}"] = float(rng.choice([-1, 1]) * rng.uniform(*_KNOB_ON_RAD))
    _put_beside(drawn, counter.STOVE_HALF_M, int(rng.integers(0, 3)))
    return Start(draft=drawn, target=Target(fixture="stove", part=asked), words={"burner": asked.replace("_", " ")})


def put_pan(drawn: Draft, burner: str) -> None:
    """Puts a pan on a burner, its handle towards the robot's left or right."""
    x, y = stove.BURNERS[burner]
    side = float(drawn.rng.choice([-1, 1]))
    yaw = -np.pi / 2 + side * float(drawn.rng.uniform(*_PAN_YAW_RAD))
    up = COUNTER_TOP_M + stove.BURNER_UP_M + 0.002
    drawn.put("pan", "pan", (drawn.x_m + x, stove.CENTER_Y_M + y, up), yaw_rad=yaw)


def microwave_buttons(rng: np.random.Generator, instances: Instances, *, is_on: bool) -> Start:
    """A shut microwave that stands still or runs."""
    drawn = draft(rng, instances, ["microwave"])
    drawn.is_microwave_on = is_on
    _put_beside(drawn, microwave.HALF_WIDTH_M, int(rng.integers(1, 4)))
    return Start(draft=drawn, target=Target(fixture="microwave"))


def coffee_button(rng: np.random.Generator, instances: Instances) -> Start:
    """A coffee machine with a mug under its dispenser."""
    return replace(coffee_serve(rng, instances), target=Target(fixture="coffee_machine"))


def coffee_serve(rng: np.random.Generator, instances: Instances) -> Start:
    """A coffee machine with a mug under its dispenser, and room on the counter."""
    drawn = draft(rng, instances, ["coffee_machine"])
    serve_mug(drawn)
    _put_beside(drawn, 0.12, int(rng.integers(0, 3)))
    return Start(draft=drawn, target=Target(fixture="coffee_machine", obj=OBJ))


def serve_mug(drawn: Draft) -> None:
    """Puts a mug under the dispenser."""
    y = coffee_machine.CENTER_Y_M + coffee_machine.MUG_Y_M
    yaw = float(drawn.rng.uniform(*_SERVED_YAW_RAD))
    drawn.put(OBJ, "mug", (drawn.x_m, y, COUNTER_TOP_M + coffee_machine.PLATE_M), yaw_rad=yaw)


def coffee_setup(rng: np.random.Generator, instances: Instances) -> Start:
    """A coffee machine with nothing under it and a mug beside it."""
    drawn = draft(rng, instances, ["coffee_machine"])
    side = int(rng.choice([-1, 1]))
    near, far = sorted((drawn.x_m + side * 0.2, drawn.x_m + side * 0.38))
    yaw = float(rng.uniform(*_MUG_YAW_RAD))
    drawn.put_somewhere(OBJ, "mug", (near, far), (-0.52, -0.38), yaw_rad=yaw)
    _put_beside(drawn, 0.12, int(rng.integers(0, 3)))
    return Start(draft=drawn, target=Target(fixture="coffee_machine", obj=OBJ))


def cabinet_pnp(rng: np.random.Generator, instances: Instances, *, is_in_cabinet: bool) -> Start:
    """An open wall cabinet; the object stands on the counter under it, or in it in front."""
    kind: FixtureKind = ("cabinet", "double_cabinet")[int(rng.integers(2))]
    drawn = draft(rng, instances, [kind], names=["cabinet"])
    joints = ["cabinet/door"] if kind == "cabinet" else ["cabinet/left_door", "cabinet/right_door"]
    open_doors(drawn, kind, joints)
    reach = cabinet.HALF_WIDTH_M["cabinet"] - 0.12
    inside_x, floor = (drawn.x_m - reach, drawn.x_m + reach), cabinet.BOTTOM_M + cabinet.WALL_M
    under_x = (drawn.x_m - _UNDER_CABINET_X_M, drawn.x_m + _UNDER_CABINET_X_M)
    word = drawn.draw_kind(objects.GRASPABLES)
    if is_in_cabinet:
        yaw = np.pi / 2 + float(rng.uniform(-_INSIDE_YAW_RAD, _INSIDE_YAW_RAD))
        drawn.put_somewhere(OBJ, word, inside_x, (-0.30, -0.26), z_m=floor, yaw_rad=yaw)
    else:
        drawn.put_somewhere(OBJ, word, under_x, _FRONT_Y_M)
        behind = drawn.draw_kind(objects.GRASPABLES)
        drawn.put_somewhere("behind", behind, inside_x, (-0.10, -0.09), z_m=floor, yaw_rad=0.0)
    drawn.distract(1, [under_x], _BACK_Y_M)
    return Start(draft=drawn, target=Target(fixture="cabinet", obj=OBJ), words={"obj": word})


def sink_pnp(rng: np.random.Generator, instances: Instances, *, is_in_sink: bool) -> Start:
    """A sink; the object lies beside it, or in it with a container beside it."""
    drawn = draft(rng, instances, ["sink"])
    beside_x, other_x = _sides(drawn, sink.HALF_WIDTH_M)
    word = drawn.draw_kind(objects.WASHABLES)
    words, container = {"obj": word}, ""
    if is_in_sink:
        x, y = (drawn.x_m - 0.15, drawn.x_m + 0.15), (sink.CENTER_Y_M - 0.06, sink.CENTER_Y_M + 0.04)
        drawn.put_somewhere(OBJ, word, x, y, z_m=COUNTER_TOP_M - 0.158)
        container, words["container"] = CONTAINER, _put_container(drawn, beside_x)
    else:
        drawn.put_somewhere(OBJ, word, beside_x, _FRONT_Y_M)
    drawn.distract(1, [other_x], _ASIDE_Y_M)
    return Start(draft=drawn, target=Target(fixture="sink", obj=OBJ, container=container), words=words)


def microwave_pnp(rng: np.random.Generator, instances: Instances, *, is_in_microwave: bool) -> Start:
    """An open microwave; the object lies on a plate beside it, or on one in it with a container beside it."""
    drawn = draft(rng, instances, ["microwave"])
    open_doors(drawn, "microwave", ["microwave/door"])
    tray_x, tray_y, tray_z = microwave.TRAY_M
    tray = (drawn.x_m + tray_x, microwave.CENTER_Y_M + tray_y, tray_z)
    right = drawn.x_m + microwave.HALF_WIDTH_M
    beside_x, beside_y = (right + 0.15, right + 0.19), (-0.52, -0.42)  # the door is in the way on the left
    word = drawn.draw_kind(objects.DISHES)
    words = {"obj": word}
    if is_in_microwave:
        drawn.put("plate", "plate", tray, yaw_rad=0.0)
        put_on(drawn, OBJ, word, "plate")
        words["container"] = _put_container(drawn, beside_x, beside_y)
    else:
        drawn.put(CONTAINER, "plate", tray, yaw_rad=0.0)
        drawn.put_somewhere("plate", "plate", beside_x, beside_y)
        put_on(drawn, OBJ, word, "plate")
    return Start(draft=drawn, target=Target(fixture="microwave", obj=OBJ, container=CONTAINER), words=words)


def stove_pnp(rng: np.random.Generator, instances: Instances, *, is_in_pan: bool) -> Start:
    """A stove with a pan; the object lies on a plate beside it, or in the pan with a container beside it."""
    drawn = draft(rng, instances, ["stove"])
    burners = list(stove.BURNERS)
    burner = burners[int(rng.integers(len(burners)))]
    put_pan(drawn, burner)
    near, far = _sides(drawn, counter.STOVE_HALF_M)
    beside_x = far if ("left" in burner) == (near[0] > drawn.x_m) else near  # on the pan's side
    word = drawn.draw_kind(objects.DISHES)
    words = {"obj": word, "pan": "pan"}
    if is_in_pan:
        put_on(drawn, OBJ, word, "pan")
        words["container"] = _put_container(drawn, beside_x)
        words["on"] = "in" if words["container"] == "bowl" else "on"
        return Start(draft=drawn, target=Target(fixture="stove", obj=OBJ, container=CONTAINER), words=words)
    drawn.put_somewhere("plate", "plate", beside_x, _FRONT_Y_M)
    put_on(drawn, OBJ, word, "plate")
    return Start(draft=drawn, target=Target(fixture="stove", obj=OBJ, container="pan"), words=words)


def put_on(drawn: Draft, name: str, kind: str, vessel: str) -> None:
    """Puts an object on the floor of a container that is in the bay."""
    below = next(each for each in drawn.objects if each.name == vessel)
    x, y, z = below.position_m
    floor = z - objects.half_of(below.kind, below.instance)[2] + objects.FLOOR_M
    shift = drawn.rng.uniform(-0.01, 0.01, size=2)
    yaw = np.pi / 2 + float(drawn.rng.uniform(-_INSIDE_YAW_RAD, _INSIDE_YAW_RAD))
    drawn.put(name, kind, (x + shift[0], y + shift[1], floor), yaw_rad=yaw)


def _put_container(drawn: Draft, x_m: Span, y_m: Span = (-0.52, -0.36)) -> str:
    """Puts a plate or a bowl on the counter, and returns which."""
    kind = ("plate", "bowl")[int(drawn.rng.integers(2))]
    drawn.put_somewhere(CONTAINER, kind, x_m, y_m)
    return kind


def _put_beside(drawn: Draft, half_m: float, num: int) -> None:
    drawn.distract(num, _sides(drawn, half_m), _ASIDE_Y_M)


def _sides(drawn: Draft, half_m: float) -> list[Span]:
    """Returns the spans of the counter beside the reference fixture, a drawn one first."""
    spans = [
        (drawn.x_m - half_m - 0.28, drawn.x_m - half_m - 0.11),
        (drawn.x_m + half_m + 0.11, drawn.x_m + half_m + 0.28),
    ]
    return spans if drawn.rng.integers(2) else spans[::-1]
