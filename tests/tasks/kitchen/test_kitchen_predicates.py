"""Every kind of predicate, on both sides of its threshold, in the tasks that use it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dual_system.tasks.kitchen.catalogue import TASKS
from dual_system.tasks.kitchen.fixtures.counter import COUNTER
from dual_system.tasks.kitchen.plan import COUNTER_TOP_M, Check
from dual_system.tasks.kitchen.predicates import KINDS, holds

Built = Callable[..., Any]
TOUCH_M = 0.002  # how deep a hand is put into a button


def seed_with(built: Built, task: str, fixture_kind: str) -> int:
    """The first seed whose reference fixture is of a kind."""
    return next(s for s in range(50) if built(task, s).scene.plan.fixtures[0].kind == fixture_kind)


@pytest.mark.parametrize("kind", ["cabinet", "microwave"])
@pytest.mark.parametrize(
    ("task", "fraction", "is_done"),
    [
        ("OpenSingleDoor", 0.899, False),
        ("OpenSingleDoor", 0.901, True),
        ("CloseSingleDoor", 0.051, False),
        ("CloseSingleDoor", 0.049, True),
    ],
)
def test_a_door(built: Built, kind: str, task: str, fraction: float, is_done: bool) -> None:
    played = built(task, seed_with(built, task, kind))
    (door,) = [d for name in (kind,) for d in _doors(played.bay.fixtures[name])]
    played.turn(door.joint, fraction * door.open_rad)
    assert (played.fired() == 0) is is_done


@pytest.mark.parametrize(
    ("task", "done", "undone"), [("OpenDoubleDoor", 0.901, 0.899), ("CloseDoubleDoor", 0.04, 0.06)]
)
def test_two_doors_both_count(built: Built, task: str, done: float, undone: float) -> None:
    played = built(task)
    left, right = _doors(played.bay.fixtures["cabinet"])
    for fractions in ((done, done), (done, undone), (undone, done), (undone, undone)):
        for door, fraction in zip((left, right), fractions, strict=True):
            played.turn(door.joint, fraction * door.open_rad)
        assert (played.fired() == 0) is (fractions == (done, done)), fractions


@pytest.mark.parametrize(
    ("task", "fraction", "is_done"),
    [
        ("OpenDrawer", 0.949, False),
        ("OpenDrawer", 0.951, True),
        ("CloseDrawer", 0.051, False),
        ("CloseDrawer", 0.049, True),
    ],
)
def test_a_drawer(built: Built, task: str, fraction: float, is_done: bool) -> None:
    played = built(task)
    slide = played.bay.fixtures["drawer"].slide
    assert slide.open_m == pytest.approx(0.55 * 0.60)
    played.turn(slide.joint, -fraction * slide.open_m)
    assert (played.fired() == 0) is is_done


@pytest.mark.parametrize(
    ("angle_rad", "runs"), [(0.399, False), (0.40, False), (0.401, True), (3.1, True), (3.2, False)]
)
def test_water_runs_above_a_band_of_the_lever(built: Built, angle_rad: float, runs: bool) -> None:
    on, off = built("TurnOnSinkFaucet"), built("TurnOffSinkFaucet")
    on.turn("sink/handle", angle_rad)
    assert (on.fired() == 0) is runs
    if angle_rad < np.pi:
        off.turn("sink/handle", angle_rad)
        assert (off.fired() == 0) is not runs


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(("beyond_rad", "is_there"), [(-0.005, False), (0.005, True)])
def test_a_spout_s_side(built: Built, side: str, beyond_rad: float, is_there: bool) -> None:
    seed = next(s for s in range(20) if built("TurnSinkSpout", s).scene.goals[0].target.part == side)
    played = built("TurnSinkSpout", seed)
    sign = 1.0 if side == "right" else -1.0
    played.turn("sink/spout", sign * (np.pi / 6 + beyond_rad))
    assert (played.fired() == 0) is is_there
    played.turn("sink/spout", -sign * (np.pi / 6 + beyond_rad))
    assert played.fired() is None


@pytest.mark.parametrize("full_turns_rad", [0.0, 2 * np.pi, -2 * np.pi])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("angle_rad", "burns"), [(0.0, False), (0.349, False), (0.351, True), (1.5, True), (3.0, True)]
)
def test_a_knob(built: Built, full_turns_rad: float, sign: float, angle_rad: float, burns: bool) -> None:
    for task, is_done in (("TurnOnStove", burns), ("TurnOffStove", not burns)):
        played = built(task)
        played.turn(f"stove/{played.scene.goals[0].target.part}", sign * angle_rad + full_turns_rad)
        assert (played.fired() == 0) is is_done, task


def test_another_knob_is_another_goal(built: Built) -> None:
    played = built("TurnOnStove")
    asked = played.scene.goals[0].target.part
    for knob in played.bay.fixtures["stove"].knobs:
        played.reset()
        played.turn(f"stove/{knob}", 1.0)
        assert (played.fired() == 0) is (knob == asked)


@pytest.mark.parametrize(("distance_m", "is_far"), [(0.249, False), (0.251, True)])
@pytest.mark.parametrize("lift_m", [0.0, 0.004])
def test_an_object_lies_and_the_hand_is_far(built: Built, distance_m: float, is_far: bool, lift_m: float) -> None:
    played = built("PnPCabToCounter")
    at = on_counter(played, "obj", lift_m)
    played.hand_at(np.add(at, [0.0, 0.0, distance_m]))
    assert (played.fired() == 0) is (is_far and lift_m == 0.0)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("out_m", "is_in"), [(0.049, True), (0.051, False)])
def test_a_box_is_inside_up_to_a_tolerance(built: Built, axis: int, side: float, out_m: float, is_in: bool) -> None:
    played = built("PnPCounterToCab")
    inside, half = played.bay.fixtures["cabinet"].inside, played.bay.objects["obj"].half_m
    at = np.array(inside.center_m)
    at[axis] += side * (inside.half_m[axis] - half[axis] + out_m)
    played.put("obj", at)
    assert (played.fired() == 0) is is_in


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("out_m", "is_in"), [(-0.001, True), (0.001, False)])
def test_a_centre_is_inside_without_a_tolerance(
    built: Built, axis: int, side: float, out_m: float, is_in: bool
) -> None:
    played = built("PnPCounterToSink")
    basin = played.bay.fixtures["sink"].basin
    at = np.array(basin.center_m)
    at[axis] += side * (basin.half_m[axis] + out_m)
    played.put("obj", at)
    assert (played.fired() == 0) is is_in


@pytest.mark.parametrize("task", ["PnPSinkToCounter", "PnPMicrowaveToCounter", "PnPStoveToCounter"])
@pytest.mark.parametrize(("radii", "is_in"), [(0.69, True), (0.71, False)])
def test_an_object_is_in_a_container_within_seven_tenths(built: Built, task: str, radii: float, is_in: bool) -> None:
    played = built(task)
    on_counter(played, "container", 0.0)
    at = on_floor_of(played, "container", radii * played.bay.objects["container"].radius_m)
    assert holds(played.view, played.memory, Check(kind="touches", of="obj", to="container", low=1.0))
    assert (played.fired() == 0) is is_in
    played.put("obj", np.add(at, [0.0, 0.0, 0.1]))
    assert played.fired() is None, "it floats above the container"


def test_the_container_stands_on_the_counter(built: Built) -> None:
    played = built("PnPSinkToCounter")
    on_counter(played, "container", 0.05)
    on_floor_of(played, "container", 0.0)
    assert played.fired() is None
    on_counter(played, "container", 0.0)
    on_floor_of(played, "container", 0.0)
    assert played.fired() == 0


@pytest.mark.parametrize(("off_m", "is_in"), [(0.069, True), (0.071, False)])
def test_an_object_is_in_the_pan_within_seven_centimetres(built: Built, off_m: float, is_in: bool) -> None:
    played = built("PnPCounterToStove")
    played.settle(0.2)
    on_floor_of(played, "pan", off_m)
    assert (played.fired() == 0) is is_in


def test_a_plate_with_the_object_stands_in_the_microwave(built: Built) -> None:
    played = built("PnPCounterToMicrowave")
    played.settle(0.2)
    assert played.fired() is None
    on_floor_of(played, "container", 0.0)
    assert played.fired() == 0
    on_counter(played, "container", 0.0)
    on_floor_of(played, "container", 0.0)
    assert played.fired() is None, "the plate is out"


@pytest.mark.parametrize(
    ("offset_m", "is_there"),
    [
        ((0.039, 0, 0), True),
        ((0.041, 0, 0), False),
        ((0, 0, 0.099), True),
        ((0, 0, -0.099), True),
        ((0, 0, 0.101), False),
    ],
)
def test_a_mug_is_under_the_dispenser(built: Built, offset_m: tuple[float, float, float], is_there: bool) -> None:
    played = built("CoffeeSetupMug")
    played.put("obj", np.add(played.bay.fixtures["coffee_machine"].receptacle_m, offset_m))
    assert (played.fired() == 0) is is_there


def test_a_served_mug_stands_on_the_counter(built: Built) -> None:
    played = built("CoffeeServeMug")
    played.settle(0.2)
    assert played.fired() is None, "it stands on the machine's plate"
    on_counter(played, "obj", 0.0)
    assert played.fired() == 0


@pytest.mark.parametrize(
    ("task", "fixture", "button"),
    [
        ("TurnOnMicrowave", "microwave", "start"),
        ("TurnOffMicrowave", "microwave", "stop"),
        ("CoffeePressButton", "coffee_machine", "start"),
    ],
)
def test_a_button_counts_once_it_is_touched_and_the_hand_is_far(
    built: Built, task: str, fixture: str, button: str
) -> None:
    played = built(task)
    handle = getattr(played.bay.fixtures[fixture], button)
    center, normal = np.array(handle.center_m), np.array(handle.normal)
    reach = handle.half_m + 0.01
    for away_m, is_touched in ((reach + 0.001, False), (reach - TOUCH_M, True)):
        played.hand_at(center + away_m * normal)
        assert played.fired() is None, "the hand is near"
        for far_m, is_far in ((0.149, False), (0.151, True)):
            played.hand_at(center + far_m * normal)
            assert (played.fired() == 0) is (is_touched and is_far)


def test_the_other_button_does_nothing(built: Built) -> None:
    for task, button, was_on in (("TurnOnMicrowave", "stop", False), ("TurnOffMicrowave", "start", True)):
        played = built(task)
        press(played, getattr(played.bay.fixtures["microwave"], button))
        assert played.memory.is_microwave_on is was_on


@pytest.mark.parametrize(("fraction", "runs"), [(0.004, True), (0.006, False)])
def test_an_open_door_stops_the_microwave(built: Built, fraction: float, runs: bool) -> None:
    played = built("TurnOffMicrowave")
    door = played.bay.fixtures["microwave"].door
    played.turn(door.joint, fraction * door.open_rad)
    played.fired()
    assert played.memory.is_microwave_on is runs
    press(played, played.bay.fixtures["microwave"].start)
    assert played.memory.is_microwave_on is runs, "an open one does not start"


def test_every_kind_is_used() -> None:
    used = {check.kind for task in TASKS.values() for check in task.checks} | {"turned"}  # of TurnSinkSpout
    assert used == set(KINDS)


def on_counter(played: Any, name: str, lift_m: float) -> Any:
    """Puts an object on a free part of the counter in front of the robot, or holds it above."""
    half_z = played.bay.objects[name].half_m[2]
    at = np.array([played.scene.plan.stand.x_m, -0.63, COUNTER_TOP_M + half_z - 0.0005 + lift_m])
    if COUNTER not in played.view.geoms or played.scene.plan.fixtures[0].kind == "stove":
        at[0] += 0.5
    played.put(name, at)
    return at


def on_floor_of(played: Any, vessel: str, off_m: float) -> Any:
    """Puts the object into a container, off its middle."""
    container, thing = played.bay.objects[vessel], played.bay.objects["obj"]
    middle = played.view.position_m(vessel)
    at = np.add(middle, [0.0, off_m, -container.half_m[2] + 0.008 + thing.half_m[2] - 0.0005])
    played.put("obj", at)
    return at


def press(played: Any, button: Any) -> None:
    played.hand_at(np.array(button.center_m) + (button.half_m + 0.01 - TOUCH_M) * np.array(button.normal))
    played.fired()


def _doors(fixture: Any) -> tuple[Any, ...]:
    return fixture.doors if hasattr(fixture, "doors") else (fixture.door,)
