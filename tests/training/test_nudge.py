"""Nudged starts: the commanded poses stay where they were, but for the way back; the tool is somewhere else."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.models.action_space import actions_in, states_in
from dual_system.models.normalisation import ROBOMME, Quantiles, RobotStatistics
from dual_system.training.nudge import NO_NUDGE, Nudge, apply_nudges, draw_nudges

HOME = np.array([0.0, 0.2, 0.0, -2.2, 0.0, 2.4, 0.8, 0.04], np.float32)
N = 12
STATISTICS = RobotStatistics(
    state=Quantiles(q01=(-0.5, -0.4, 0.0, -0.1, -0.1, -1.0, 0.0), q99=(0.3, 0.4, 0.6, 0.1, 0.1, 1.0, 0.04)),
    action=Quantiles(q01=(-0.2,) * 6 + (-1.0,), q99=(0.3,) * 6 + (1.0,)),
    space="ee_delta",
    reach=tuple(0.1 + 0.1 * n for n in range(N)),
)


@given(seed=st.integers(0, 1000), return_rows=st.integers(1, N))
@settings(max_examples=20, deadline=None)
def test_commands_begin_where_the_tool_is_put_and_end_where_they_ended(seed: int, return_rows: int) -> None:
    rng = np.random.default_rng(seed)
    states = HOME + rng.uniform(-0.1, 0.1, (3, 8)).astype(np.float32)
    targets = HOME + rng.uniform(-0.1, 0.1, (N, 8)).astype(np.float32)
    rows = np.tile(np.arange(N), (3, 1))
    nudge = Nudge(std_m=0.03, return_rows=return_rows)
    moves = draw_nudges(nudge, states, np.tile(targets, (3, 1, 1)), rng)
    state, actions = apply_nudges(
        nudge,
        moves,
        torch.from_numpy(STATISTICS.normalise_states(states)),
        torch.from_numpy(STATISTICS.normalise_chunks(targets, states, rows)),
        STATISTICS,
    )
    here = STATISTICS.state.denormalise(state.numpy())
    relative = STATISTICS.action.denormalise(actions.numpy())
    relative[..., :6] *= np.array(STATISTICS.reach)[:, None]
    was_here = states_in("ee_delta", states)
    was_there = actions_in("ee_delta", targets, states, rows)[..., :2] + was_here[:, None, :2]
    np.testing.assert_allclose(here[:, :2], was_here[:, :2] + moves, atol=1e-5)
    np.testing.assert_allclose(here[:, 2:], was_here[:, 2:], atol=1e-5)
    there = relative[..., :2] + here[:, None, :2]
    np.testing.assert_allclose(there[:, return_rows - 1 :], was_there[:, return_rows - 1 :], atol=1e-4)
    left = 1 - 1 / return_rows
    np.testing.assert_allclose(there[:, 0], was_there[:, 0] + left * moves, atol=1e-4)


def test_near_the_table_nobody_is_nudged() -> None:
    low = np.array([0.0, 0.75, 0.0, -2.2, 0.0, 2.95, 0.8, 0.04], np.float32)
    height_m = states_in("ee_delta", low[None])[0, 2]
    assert height_m < 0.03
    stays = np.tile(HOME, (1, N, 1))
    assert not draw_nudges(Nudge(std_m=0.1), low[None], stays, np.random.default_rng(0)).any()
    assert draw_nudges(Nudge(std_m=0.1), HOME[None], stays, np.random.default_rng(0)).all()


@given(row=st.integers(0, N), return_rows=st.integers(1, N - 1))
@settings(max_examples=30, deadline=None)
def test_where_something_is_let_go_of_before_the_tool_is_back_starts_are_spared_if_asked(
    row: int, return_rows: int
) -> None:
    carries = np.tile(HOME, (2, N, 1))
    carries[:, :, 7] = -1.0
    carries[1, row:, 7] = 1.0  # from its first row on it is open already: nothing is let go of
    draw = {
        spares: draw_nudges(
            Nudge(std_m=0.1, return_rows=return_rows, spares_release=spares),
            np.tile(HOME, (2, 1)),
            carries,
            np.random.default_rng(0),
        )
        for spares in (False, True)
    }
    is_spared = 0 < row <= return_rows
    np.testing.assert_array_equal(draw[True][0], draw[False][0])
    np.testing.assert_array_equal(draw[True][1], 0.0 if is_spared else draw[False][1])
    assert draw[False].all()


def test_joint_deltas_are_refused() -> None:
    with pytest.raises(ValueError, match="'ee_delta', these statistics are of 'joint_delta'"):
        apply_nudges(NO_NUDGE, np.zeros((1, 2), np.float32), torch.zeros(1, 8), torch.zeros(1, 4, 8), ROBOMME)
    with pytest.raises(ValueError, match="return_rows at least 1"):
        Nudge(return_rows=0)
