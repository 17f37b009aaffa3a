"""Laws of the units: there and back, quantiles at the ends of [-1, 1], arm relative and gripper absolute."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dual_system.models.arm import NUM_ARM_JOINTS
from dual_system.models.normalisation import ROBOMME, Quantiles

rows = arrays(np.float32, (5, 8), elements=st.floats(-3, 3, width=32))
states = arrays(np.float32, 8, elements=st.floats(-3, 3, width=32))


@settings(deadline=None)
@given(values=rows)
def test_denormalise_inverts_normalise(values: np.ndarray) -> None:
    for table in (ROBOMME.state, ROBOMME.action):
        np.testing.assert_allclose(table.denormalise(table.normalise(values)), values, atol=1e-5)


@pytest.mark.parametrize("table", [ROBOMME.state, ROBOMME.action], ids=["state", "action"])
def test_quantiles_map_to_the_ends(table: Quantiles) -> None:
    np.testing.assert_allclose(table.normalise(table.q01), -1.0, atol=1e-6)
    np.testing.assert_allclose(table.normalise(table.q99), 1.0, atol=1e-4)  # the public epsilon in the denominator


def test_values_beyond_the_quantiles_are_not_clipped() -> None:
    beyond = np.asarray(ROBOMME.action.q99) + 1.0
    assert (ROBOMME.action.normalise(beyond) > 1.5).all()


@settings(deadline=None)
@given(targets=rows, state=states)
def test_absolute_targets_invert_normalise_targets(targets: np.ndarray, state: np.ndarray) -> None:
    targets[:, NUM_ARM_JOINTS] = targets[:, NUM_ARM_JOINTS].clip(-1, 1)
    actions = ROBOMME.normalise_targets(targets, state)
    np.testing.assert_allclose(ROBOMME.absolute_targets(actions, state), targets, atol=1e-5)


@settings(deadline=None)
@given(actions=rows, state=states)
def test_arm_moves_with_the_state_and_gripper_does_not(actions: np.ndarray, state: np.ndarray) -> None:
    here, zero = ROBOMME.absolute_targets(actions, state), ROBOMME.absolute_targets(actions, np.zeros(8))
    arm = slice(0, NUM_ARM_JOINTS)
    np.testing.assert_allclose(here[:, arm] - zero[:, arm], np.tile(state[arm], (5, 1)), atol=1e-5)
    np.testing.assert_array_equal(here[:, NUM_ARM_JOINTS], zero[:, NUM_ARM_JOINTS])


def test_gripper_is_clipped_to_its_command_range() -> None:
    actions = np.zeros((2, 8))
    actions[:, NUM_ARM_JOINTS] = [-7.0, 7.0]
    np.testing.assert_array_equal(ROBOMME.absolute_targets(actions, np.zeros(8))[:, NUM_ARM_JOINTS], [-1.0, 1.0])


def test_inputs_are_left_alone() -> None:
    targets, state = np.ones((2, 8), dtype=np.float32), np.full(8, 0.5, dtype=np.float32)
    ROBOMME.normalise_targets(targets, state)
    assert (targets == 1.0).all()
    assert (state == 0.5).all()


def test_crossed_or_uneven_quantiles_are_refused() -> None:
    with pytest.raises(ValueError, match="exceeds"):
        Quantiles(q01=(0.0, 1.0), q99=(1.0, 0.5))
    with pytest.raises(ValueError, match="q01 has 2 dims and q99 1"):
        Quantiles(q01=(0.0, 1.0), q99=(1.0,))
