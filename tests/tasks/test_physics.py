"""The world: exact control steps, exact restores, firm grasps, a button on a spring."""

from __future__ import annotations

import numpy as np
import pytest

from dual_system.tasks import panda
from dual_system.tasks.geometry import pose
from dual_system.tasks.physics import CONTROL_HZ, Physics, whole_substeps
from dual_system.tasks.predicates import is_dropped, is_picked, is_pressed

HOME = np.append(panda.HOME_QPOS, 1.0)


def advance(world: Physics, num_steps: int, action: np.ndarray = HOME) -> None:
    for _ in range(num_steps):
        world.advance(action)


def test_a_control_step_is_exactly_50_ms(world: Physics) -> None:
    advance(world, 40)
    assert world.data.time == pytest.approx(2.0, abs=1e-9)


@pytest.mark.parametrize(("timestep_s", "substeps"), [(0.002, 25), (0.0025, 20), (0.005, 10), (0.01, 5)])
def test_substeps_fill_a_control_step(timestep_s: float, substeps: int) -> None:
    assert whole_substeps(timestep_s, CONTROL_HZ) == substeps


@pytest.mark.parametrize("timestep_s", [0.003, 0.06, 0.1])
def test_a_physics_step_that_does_not_fit_is_refused(timestep_s: float) -> None:
    with pytest.raises(ValueError, match="does not divide the control period of 50 ms"):
        whole_substeps(timestep_s, CONTROL_HZ)


def test_restored_state_continues_bit_exactly(world: Physics) -> None:
    world.place("cube", pose(-0.1, 0.05, 0.05, 0.7))  # it is about to fall
    world.place("button", pose(-0.2, 0, 0))
    world.refresh()
    rng = np.random.default_rng(0)
    actions = HOME + rng.normal(0, 0.1, (30, 8))
    for action in actions[:5]:
        world.advance(action)
    fork = world.save()

    def run() -> list[bytes]:
        states = []
        for action in actions[5:]:
            world.advance(action)
            states.append(world.data.qpos.tobytes() + world.data.qvel.tobytes() + world.data.xpos.tobytes())
        return states

    first = run()
    world.load(fork)
    assert run() == first


def test_a_saved_state_is_a_copy(world: Physics) -> None:
    fork = world.save()
    before = fork.integration.copy()
    advance(world, 3, HOME + 0.1)
    np.testing.assert_array_equal(fork.integration, before)


def test_paint_is_restored_and_reset(world: Physics) -> None:
    world.paint("cube", (1, 0, 0, 1))
    fork = world.save()
    world.paint("cube", (0, 1, 0, 1))
    world.load(fork)
    np.testing.assert_array_equal(world.model.geom("cube").rgba, [1, 0, 0, 1])
    world.reset()
    assert not np.array_equal(world.model.geom("cube").rgba, [1, 0, 0, 1])


def test_a_parked_prop_floats_at_rest(world: Physics) -> None:
    before = world.pose("cube")
    advance(world, 200)
    np.testing.assert_allclose(world.pose("cube"), before, atol=1e-9)


def test_a_placed_prop_falls_to_the_table_and_stays(world: Physics) -> None:
    world.place("cube", pose(-0.1, 0.1, 0.1, 0.3))
    world.refresh()
    advance(world, 40)
    np.testing.assert_allclose(world.position_m("cube"), [-0.1, 0.1, 0.02], atol=5e-4)
    assert is_dropped(world, "cube")
    assert not is_picked(world, "cube")


def test_the_arm_holds_its_pose_against_gravity(world: Physics) -> None:
    advance(world, 60)
    np.testing.assert_allclose(world.arm_qpos(), panda.HOME_QPOS, atol=1e-4)


def test_the_arm_lags_its_target_by_the_time_constant_of_its_gains(world: Physics) -> None:
    target = panda.HOME_QPOS.copy()
    for _ in range(20):
        target[0] += 0.03  # 0.6 rad/s
        world.advance(np.append(target, 1.0))
    # kd / kp = 100 ms behind a ramp, less half a control step: the target's stairs run that much ahead of a ramp
    assert target[0] - world.arm_qpos()[0] == pytest.approx(0.6 * (0.1 - 0.025), abs=0.002)


def test_the_gripper_closes_as_recorded(world: Physics) -> None:
    openings_m = []
    for _ in range(5):
        world.advance(np.append(panda.HOME_QPOS, -1.0))
        openings_m.append(world.finger_openings_m()[0])
    np.testing.assert_allclose(openings_m, [0.0204, 0.0085, 0.0012, 0.0, 0.0], atol=0.003)


def test_the_cap_rests_on_its_spring(world: Physics) -> None:
    world.place("button", pose(-0.2, 0.1, 0))
    world.refresh()
    advance(world, 40)
    assert world.travel_m("button/cap") == pytest.approx(-0.04267 * 9.81 / 800, abs=1e-5)
    assert not is_pressed(world, "button")


def test_a_held_cap_counts_as_pressed_and_springs_back(world: Physics) -> None:
    world.place("button", pose(-0.2, 0.1, 0))
    world.data.joint("button/cap").qpos = -0.0051
    world.refresh()
    assert is_pressed(world, "button")
    world.data.joint("button/cap").qpos = -0.0049
    assert not is_pressed(world, "button")
    world.data.joint("button/cap").qpos = -0.0147
    advance(world, 10)
    assert not is_pressed(world, "button")


def grasp(world: Physics, cube_offset_m: float = 0.0) -> None:
    """Puts the cube between the open fingers at home, closes them, and lets physics hold it in the air."""
    x_m, y_m, z_m = world.tcp_transform()[:3, 3]
    world.place("cube", pose(x_m, y_m + cube_offset_m, z_m))
    world.data.body("cube").xfrc_applied[2] = 0.064 * 9.81  # let go of once it is held
    world.refresh()
    advance(world, 8, np.append(panda.HOME_QPOS, -1.0))
    world.data.body("cube").xfrc_applied[:] = 0


def test_a_cube_between_closed_fingers_is_grasped_and_stays(world: Physics) -> None:
    grasp(world)
    before = world.position_m("cube")
    advance(world, 60, np.append(panda.HOME_QPOS, -1.0))
    assert is_picked(world, "cube")
    np.testing.assert_allclose(world.position_m("cube"), before, atol=1e-3)


def test_the_grip_does_not_chatter(world: Physics) -> None:
    grasp(world)
    openings_m = []
    for _ in range(40):
        world.advance(np.append(panda.HOME_QPOS, -1.0))
        openings_m.append(world.finger_openings_m())
    assert np.ptp(openings_m, axis=0).max() < 1e-3
    assert np.mean(openings_m) == pytest.approx(0.02, abs=1.5e-3)


def test_an_opened_hand_lets_go(world: Physics) -> None:
    grasp(world)
    advance(world, 40, HOME)
    assert not world.is_grasped("cube")
    assert is_dropped(world, "cube")


def test_what_is_loaded_is_what_was_saved(world: Physics) -> None:
    grasp(world)  # contacts, so that the solver's warm start matters
    advance(world, 3, np.append(panda.HOME_QPOS + 0.02, -1.0))
    fork = world.save()
    advance(world, 3)
    world.load(fork)
    np.testing.assert_array_equal(world.save().integration, fork.integration)


def test_pushing_with_both_finger_tips_is_not_grasping(world: Physics) -> None:
    closed = np.append(panda.HOME_QPOS, -1.0)
    advance(world, 10, closed)
    x_m, y_m, z_m = world.tcp_transform()[:3, 3]
    world.place("cube", pose(x_m, y_m, z_m - 0.0295))
    world.data.body("cube").xfrc_applied[2] = 0.064 * 9.81 + 5.0  # pressed against the tips from below
    world.refresh()
    advance(world, 2, closed)
    touching = {world.model.body(world.model.geom_bodyid[geom]).name for geom in world.data.contact.geom.ravel()}
    assert {"leftfinger", "rightfinger", "cube"} <= touching
    assert not world.is_grasped("cube")


def test_one_finger_alone_does_not_grasp(world: Physics) -> None:
    x_m, y_m, z_m = world.tcp_transform()[:3, 3]
    world.place("cube", pose(x_m, y_m + 0.0205, z_m))  # touches one finger of the open hand
    world.data.body("cube").xfrc_applied[1] = 5.0
    world.data.body("cube").xfrc_applied[2] = 0.064 * 9.81
    world.refresh()
    advance(world, 2, HOME)
    assert world.data.ncon > 0
    assert not world.is_grasped("cube")
