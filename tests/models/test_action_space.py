"""Laws of the action spaces: there and back, straight motions are straight lines, limits hold, nothing ever raises."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dual_system.models.action_space import ActionSpace, actions_in, num_dims, states_in, targets_from
from dual_system.models.arm import JOINT_HIGH_RAD, JOINT_LOW_RAD, NUM_ARM_JOINTS, rotations, tool_poses
from dual_system.models.normalisation import ROBOMME, Quantiles, RobotStatistics

HOME = np.array([0.0, 0.0, 0.0, -np.pi / 2, 0.0, np.pi / 2, np.pi / 4, 0.04])
SPACES: tuple[ActionSpace, ...] = ("joint_delta", "ee_delta")
EE = RobotStatistics(
    state=Quantiles(q01=(-0.5,) * 7, q99=(0.5,) * 7),
    action=Quantiles(q01=(-0.2,) * 7, q99=(0.2,) * 7),
    space="ee_delta",
)

near_home = arrays(np.float64, 8, elements=st.floats(-0.3, 0.3)).map(lambda offset: HOME + offset)
chunks = arrays(np.float64, (6, 8), elements=st.floats(-0.05, 0.05)).map(lambda steps: np.cumsum(steps, axis=0))
anything = arrays(np.float64, (4, 7), elements=st.floats(-20, 20))


def chunk_in(space: ActionSpace, targets_N8: np.ndarray, state_8: np.ndarray) -> np.ndarray:
    return actions_in(space, targets_N8, state_8[None], np.arange(len(targets_N8))[None])[0]


@settings(deadline=None, max_examples=40)
@given(state=near_home, moves=chunks)
def test_a_chunk_there_and_back_brings_the_tool_to_the_same_places(state: np.ndarray, moves: np.ndarray) -> None:
    targets = state + moves
    actions = EE.normalise_targets(targets, state)
    again = EE.absolute_targets(actions, state)
    there, came = tool_poses(targets[:, :7]), tool_poses(again[:, :7])
    np.testing.assert_allclose(came.position_m, there.position_m, atol=2e-5)
    np.testing.assert_allclose(came.rotation, there.rotation, atol=3e-4)
    np.testing.assert_allclose(again[:, 7], targets[:, 7].clip(-1, 1), atol=1e-6)


@pytest.mark.parametrize("space", SPACES)
@settings(deadline=None, max_examples=15)
@given(state=near_home, moves=chunks)
def test_many_chunks_at_once_are_each_chunk_alone(space: ActionSpace, state: np.ndarray, moves: np.ndarray) -> None:
    states, targets = np.stack([state, HOME]), state + moves
    rows = np.array([[0, 1, 2, 3], [3, 4, 5, 5]])
    together = actions_in(space, targets, states, rows)
    assert together.shape == (2, 4, num_dims(space))
    for chunk, start, ticks in zip(together, states, rows, strict=True):
        np.testing.assert_allclose(chunk, chunk_in(space, targets[ticks], start), atol=1e-12)


@settings(deadline=None, max_examples=20)
@given(
    move=arrays(np.float64, 3, elements=st.floats(-0.08, 0.08)).map(lambda move: move - np.array([0, 0, 0.15])),
    turn=arrays(np.float64, 3, elements=st.floats(-0.2, 0.2)),
)
def test_a_straight_move_with_a_steady_turn_is_a_straight_line_of_numbers(move: np.ndarray, turn: np.ndarray) -> None:
    line = np.linspace(0, 1, 20)[:, None] * np.concatenate([move, turn, [1.0]])
    targets = targets_from("ee_delta", line, HOME)
    tool, start = tool_poses(targets[:, :7]), tool_poses(HOME[:7])
    np.testing.assert_allclose(tool.position_m, start.position_m + np.linspace(0, 1, 20)[:, None] * move, atol=3e-5)
    np.testing.assert_allclose(tool.rotation[-1], rotations(turn) @ start.rotation, atol=3e-4)
    np.testing.assert_allclose(chunk_in("ee_delta", targets, HOME), line, atol=3e-4)
    assert np.abs(np.diff(targets[:, :7], axis=0)).max() < 0.2  # the arm does not jump


@settings(deadline=None, max_examples=30)
@given(actions=anything, state=arrays(np.float64, 8, elements=st.floats(-4, 4)))
def test_whatever_is_asked_the_joints_stay_within_their_limits(actions: np.ndarray, state: np.ndarray) -> None:
    targets = targets_from("ee_delta", actions, state)
    assert np.isfinite(targets).all()
    assert (targets[:, :7] >= JOINT_LOW_RAD).all()
    assert (targets[:, :7] <= JOINT_HIGH_RAD).all()
    assert (np.abs(targets[:, 7]) <= 1).all()
    np.testing.assert_array_equal(targets, targets_from("ee_delta", actions, state))


def test_out_of_reach_the_arm_comes_nearer() -> None:
    line = np.linspace(0, 1, 20)[:, None] * np.array([2.0, 0, 0, 0, 0, 0, 1])
    tool = tool_poses(targets_from("ee_delta", line, HOME)[:, :7])
    assert tool.position_m[-1, 0] > 0.1


def test_what_is_no_number_is_left_to_the_limits_in_front_of_the_robot() -> None:
    assert np.isnan(targets_from("ee_delta", np.full((3, 7), np.nan), HOME)).all()


@pytest.mark.parametrize("space", SPACES)
def test_standing_still_is_zero(space: ActionSpace) -> None:
    np.testing.assert_allclose(chunk_in(space, HOME[None], HOME)[0, :-1], 0.0, atol=1e-12)


def test_the_network_reads_where_the_tool_is_and_how_far_it_is_turned() -> None:
    turned = HOME + np.array([0, 0, 0, 0, 0, 0, -0.3, 0])  # joint 7 turns about the tool's own axis, which points down
    states = states_in("ee_delta", np.stack([HOME, turned]))
    np.testing.assert_allclose(states[0], [-0.0605, 0.0, 0.5211, 0.0, 0.0, 0.0, 0.04], atol=1e-4)
    np.testing.assert_allclose(states[1], [-0.0605, 0.0, 0.5211, 0.0, 0.0, 0.3, 0.04], atol=1e-4)


def test_a_robot_without_a_gripper_is_the_same_arm() -> None:
    state = np.append(HOME[:NUM_ARM_JOINTS], 0.0)
    targets = np.append(HOME[:NUM_ARM_JOINTS] + 0.05, -1.0)[None]
    again = targets_from("ee_delta", chunk_in("ee_delta", targets, state), state)
    assert again[0, 7] == -1.0
    for space in SPACES:
        assert states_in(space, state)[-1] == 0.0
    tip = np.array([0.0, 0.0, 0.15 - 0.1034])  # in the tool's frame
    for joints in (targets, again):
        tool = tool_poses(joints[0, :7])
        np.testing.assert_allclose(
            tool.position_m + tool.rotation @ tip,
            tool_poses(targets[0, :7]).position_m + tool.rotation @ tip,
            atol=2e-5,
        )


def test_another_space_or_its_dims_are_refused() -> None:
    with pytest.raises(ValueError, match="expected an action space of joint_delta, ee_delta, native, came 'ee_pose'"):
        RobotStatistics(state=ROBOMME.state, action=ROBOMME.action, space="ee_pose")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="statistics in space 'ee_delta' need 7 state dims, came 8"):
        RobotStatistics(state=ROBOMME.state, action=ROBOMME.action, space="ee_delta")
    with pytest.raises(ValueError, match="statistics in space 'joint_delta' need 8 state dims, came 7"):
        RobotStatistics(state=EE.state, action=EE.action)
