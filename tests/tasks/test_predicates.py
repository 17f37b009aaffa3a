"""Readings of one instant, at their thresholds."""

from __future__ import annotations

import numpy as np
import pytest

from dual_system.tasks import panda, predicates
from dual_system.tasks.geometry import pose
from dual_system.tasks.physics import Physics

HOME_XY_M = (-0.0605, 0.0)  # where the tool is at home


def put(world: Physics, name: str, x_m: float, y_m: float, z_m: float) -> None:
    world.place(name, pose(x_m, y_m, z_m))
    world.refresh()


@pytest.mark.parametrize(("x_m", "z_m", "expected"), [(0.049, 0.02, True), (0.051, 0.02, False), (0.0, 0.04, False)])
def test_dropped_onto_is_within_5_cm_and_on_the_table(world: Physics, x_m: float, z_m: float, expected: bool) -> None:
    put(world, "disc", 0.0, 0.2, 0.005)
    put(world, "cube", x_m, 0.2, z_m)
    assert predicates.is_dropped_onto(world, "cube", "disc") == expected


@pytest.mark.parametrize(("x_m", "z_m", "expected"), [(0.029, 0.119, True), (0.031, 0.1, False), (0.0, 0.121, False)])
def test_over_is_near_and_low(world: Physics, x_m: float, z_m: float, expected: bool) -> None:
    put(world, "disc", 0.0, 0.2, 0.005)
    put(world, "cube", x_m, 0.2, z_m)
    assert predicates.is_over(world, "cube", "disc", within_m=0.03, below_z_m=0.12) == expected


def test_an_open_hand_that_is_away_has_let_go(world: Physics) -> None:
    put(world, "cube", 0.1, 0.2, 0.02)
    assert predicates.is_let_go(world, "cube")
    world.data.joint(panda.FINGER_JOINTS[1]).qpos = -0.019  # one finger is enough to say no
    world.refresh()
    assert not predicates.is_let_go(world, "cube")


def test_an_open_hand_around_a_cube_has_not_let_go(world: Physics) -> None:
    x_m, y_m, z_m = world.tcp_transform()[:3, 3]
    put(world, "cube", x_m, y_m, z_m - 0.019)
    assert not predicates.is_let_go(world, "cube")
    put(world, "cube", x_m, y_m, z_m - 0.021)
    assert predicates.is_let_go(world, "cube")


def test_a_hand_high_above_the_button_does_not_hover(world: Physics) -> None:
    put(world, "button", *HOME_XY_M, 0.0)
    assert world.tcp_transform()[2, 3] > 0.5
    assert not predicates.is_hovering(world, "button")


@pytest.mark.parametrize(("offset_m", "expected"), [(0.029, True), (0.031, False)])
def test_a_low_hand_hovers_within_3_cm(world: Physics, offset_m: float, expected: bool) -> None:
    world.data.joint("joint4").qpos, world.data.joint("joint2").qpos = -2.6, 0.2
    world.data.joint("joint6").qpos = 2.8
    world.refresh()
    x_m, y_m, z_m = world.tcp_transform()[:3, 3]
    assert z_m < 0.2
    put(world, "button", x_m + offset_m, y_m, 0.0)
    assert predicates.is_hovering(world, "button") == expected


def test_of_several_cubes_the_picked_one_is_named(world: Physics) -> None:
    x_m, y_m, z_m = world.tcp_transform()[:3, 3]
    put(world, "cube", x_m, y_m, z_m)
    world.data.body("cube").xfrc_applied[2] = 0.064 * 9.81
    for _ in range(8):
        world.advance(np.append(panda.HOME_QPOS, -1.0))
    assert predicates.first_picked(world, ["cube"]) == "cube"
    assert predicates.first_picked(world, []) is None


@pytest.mark.parametrize(("speed_rad_s", "expected"), [(0.19, True), (-0.19, True), (0.21, False), (-0.21, False)])
def test_an_arm_is_still_if_no_joint_turns_fast(world: Physics, speed_rad_s: float, expected: bool) -> None:
    world.data.joint(panda.ARM_JOINTS[3]).qvel = speed_rad_s
    assert predicates.is_still(world) == expected
