"""The mobile arm alone: its layouts against RoboCasa's, its controller against robosuite's, step by step."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from dual_system.tasks.kitchen import layout, omron
from dual_system.tasks.kitchen.control import BASE_VELOCITY, POSITION_M, ROTATION_RAD, Controller, rotation_of
from dual_system.tasks.kitchen.layout import ACTION, STATE, StateReader, quaternion_xyzw

RECORDED = json.loads((Path(__file__).parent / "data" / "robosuite_pandaomron.json").read_text())
HOLD = np.zeros(layout.NUM_ACTION)


class Alone:
    """The robot in robosuite's air, its base 0.56 m behind the origin, above nothing that it could touch."""

    def __init__(self, timestep_s: float = 0.005) -> None:
        spec = mujoco.MjSpec()
        spec.option.timestep = timestep_s
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.density, spec.option.viscosity = omron.AIR
        stand = spec.worldbody.add_site(name="stand", pos=[-0.56, 0.0, 0.0])
        spec.attach(omron.panda_omron_spec(), prefix="", site=stand)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        omron.start(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        self.controller = Controller(self.model)
        self.controller.begin(self.data)
        self.reader = StateReader(self.model)

    def play(self, action: np.ndarray, steps: int = 1) -> np.ndarray:
        for _ in range(steps):
            self.controller.advance(self.data, action)
        return self.state()

    def state(self) -> np.ndarray:
        return self.reader.state(self.data)


@pytest.fixture(scope="module")
def alone() -> Alone:
    return Alone()


def action(**parts: object) -> np.ndarray:
    values = HOLD.copy()
    for name, value in parts.items():
        values[ACTION[name]] = value
    return values


def test_the_state_has_robocasas_53_numbers_in_its_order() -> None:
    sizes = [7, 7, 7, 7, 3, 4, 2, 2, 3, 4, 3, 4]
    assert [size for _, size in layout.STATE_PARTS] == sizes
    assert layout.NUM_STATE == sum(sizes) == 53 == len(set(layout.STATE_NAMES))
    assert layout.STATE_NAMES[28:35] == (
        "eef_pos_x", "eef_pos_y", "eef_pos_z", "eef_quat_x", "eef_quat_y", "eef_quat_z", "eef_quat_w",
    )  # fmt: skip


def test_the_action_has_robocasas_12_numbers_and_not_robocasa365s_order() -> None:
    assert layout.NUM_ACTION == 12 == len(set(layout.ACTION_NAMES))
    assert [(name, part.start, part.stop) for name, part in ACTION.items()] == [
        ("arm_position", 0, 3),
        ("arm_rotation", 3, 6),
        ("gripper", 6, 7),
        ("base_velocity", 7, 10),
        ("torso", 10, 11),
        ("mode", 11, 12),
    ]


def test_every_number_of_the_first_state_is_robosuites(alone: Alone) -> None:
    step, recorded = RECORDED["states"][0]
    assert step == 0
    for name, found, wanted in zip(layout.STATE_NAMES, Alone().state(), recorded, strict=True):
        assert found == pytest.approx(wanted, abs=2e-5), name


@pytest.mark.parametrize(("timestep_s", "scale"), [(0.002, 1.0), (0.005, 4.0)])
def test_the_controller_moves_as_robosuites_does(timestep_s: float, scale: float) -> None:
    """Deltas, turns, both ways of the gripper, driving, turning on the spot, driving while turned, lifting the torso.

    robosuite integrates at 2 ms and we at 5 ms; at 2 ms the two differ by 2 mm and 2 mrad at most.
    """
    bounds = {"joint_pos": 2e-3, "joint_vel": 0.02, "eef_pos": 2e-3, "eef_quat": 2e-3, "gripper_qpos": 5e-5}
    bounds |= {"base_pos": 2e-3, "base_quat": 2e-3, "base_to_eef_pos": 2e-3, "base_to_eef_quat": 2e-3}
    robot, recorded, step = Alone(timestep_s), dict(RECORDED["states"]), 0
    moved = 0.0
    for times, values in RECORDED["actions"]:
        for _ in range(times):
            state = robot.play(np.array(values))
            step += 1
            if step in recorded:
                wanted = np.array(recorded[step])
                moved = max(moved, float(np.abs(wanted - RECORDED["states"][0][1])[STATE["eef_pos"]].max()))
                for name, bound in bounds.items():
                    assert np.abs(state - wanted)[STATE[name]].max() < scale * bound, (step, name)
    assert step == 110
    assert moved > 0.2


def test_a_hand_at_rest_stays_where_it_is(alone: Alone) -> None:
    before = alone.state()
    after = alone.play(HOLD, 40)
    np.testing.assert_allclose(after[STATE["eef_pos"]], before[STATE["eef_pos"]], atol=1e-3)


@pytest.mark.parametrize("axis", range(3))
def test_a_unit_of_position_pulls_along_its_axis_of_the_base(axis: int) -> None:
    robot = Alone()
    robot.play(action(base_velocity=(0.0, 0.0, 1.0), mode=1.0), 12)  # the base's axes are not the world's
    robot.play(HOLD, 10)
    before = robot.state()
    assert abs(before[STATE["base_quat"]][2]) > 0.2
    unit = np.eye(3)[axis]
    moved_m = (robot.play(action(arm_position=unit), 8) - before)[STATE["base_to_eef_pos"]]
    assert moved_m @ unit > POSITION_M
    assert np.abs(moved_m - unit * moved_m[axis]).max() < 0.2 * moved_m[axis]


def test_a_unit_of_rotation_turns_about_its_axis_of_the_base() -> None:
    robot = Alone()
    before = robot.controller.hand(robot.data)[1]
    robot.play(action(arm_rotation=(0.0, 0.0, 1.0)), 4)
    turn = robot.controller.hand(robot.data)[1] @ before.T
    angle = np.arctan2(turn[1, 0], turn[0, 0])
    assert 0.2 < angle < 4 * ROTATION_RAD
    np.testing.assert_allclose(turn, rotation_of(np.array([0.0, 0.0, angle])), atol=0.05)


def test_the_gripper_closes_on_a_positive_command_and_opens_on_a_negative_one() -> None:
    robot = Alone()
    closed = robot.play(action(gripper=1.0), 25)[STATE["gripper_qpos"]]
    opened = robot.play(action(gripper=-1.0), 25)[STATE["gripper_qpos"]]
    np.testing.assert_allclose(closed, 0.0, atol=2e-3)
    np.testing.assert_allclose(opened, [omron.OPEN_M, -omron.OPEN_M], atol=2e-3)


def test_in_mode_1_the_hand_rides_with_the_base() -> None:
    robot = Alone()
    before = robot.state()
    after = robot.play(action(base_velocity=(0.8, 0.0, 0.0), mode=1.0), 20)
    driven_m = (after - before)[STATE["base_pos"]]
    assert 0.3 < driven_m[0] < BASE_VELOCITY[0]
    np.testing.assert_allclose(after[STATE["base_to_eef_pos"]], before[STATE["base_to_eef_pos"]], atol=0.01)


def test_without_mode_the_hands_goal_is_counted_from_where_it_is() -> None:
    """A unit action that never ends keeps the hand moving: its goal is not added up, it leads by 5 cm."""
    robot = Alone()
    robot.play(action(arm_position=(0.0, 0.0, 1.0)), 5)
    ahead_m = robot.controller.goal.position_m - robot.controller.hand(robot.data)[0]
    assert 0.0 < ahead_m[2] <= POSITION_M


def test_actions_are_clipped() -> None:
    wild, tame = Alone(), Alone()
    far = action(arm_position=(9.0, 0.0, 0.0), base_velocity=(-7.0, 0.0, 0.0))
    np.testing.assert_array_equal(wild.play(far, 3), tame.play(np.clip(far, -1, 1), 3))


def test_the_cameras_ride_on_the_support_and_the_hand(alone: Alone) -> None:
    model = alone.model
    assert [model.camera(i).name for i in range(model.ncam)] == list(omron.VIEWS)
    bodies = [model.body(int(model.cam_bodyid[i])).name for i in range(model.ncam)]
    assert bodies == ["support", "support", "right_hand"]
    np.testing.assert_allclose(model.camera("ego_view").pos, [-0.5, 0.35, 1.05])
    np.testing.assert_allclose(model.camera("ego_view_right").quat, [0.67751, 0.37679, -0.29935, -0.55624], atol=1e-5)
    np.testing.assert_allclose(model.cam_fovy, [60, 60, 75])


def test_the_skin_is_light_and_only_hulls_are_felt(alone: Alone) -> None:
    model = alone.model
    seen = [g for g in range(model.ngeom) if model.geom_group[g] == 1]
    faces = sum(int(model.mesh_facenum[model.geom_dataid[g]]) for g in seen if model.geom_dataid[g] >= 0)
    assert 10 < len(seen) <= 26
    assert 2_000 < faces < 9_000
    for geom in range(model.ngeom):
        assert bool(model.geom_contype[geom]) == (model.geom_group[geom] == 0), model.geom(geom).name


def test_the_arm_feels_itself_never_and_the_world_always(alone: Alone) -> None:
    model = alone.model
    felt = [g for g in range(model.ngeom) if model.geom_contype[g]]
    assert len(felt) > 10
    assert not any(model.geom_contype[a] & model.geom_conaffinity[b] for a in felt for b in felt)


@pytest.mark.parametrize("angle", [0.3, -2.5])
def test_quaternions_are_xyzw_with_a_positive_scalar(angle: float) -> None:
    quaternion = quaternion_xyzw(rotation_of(np.array([0.0, 0.0, angle])))
    assert quaternion[3] >= 0
    np.testing.assert_allclose(quaternion[:3], [0, 0, np.sin(angle / 2)], atol=1e-9)
