"""The last gate before the robot."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from clock.limits import Hit, within_limits
from protocol.messages import Floats, Robot

DIM = 3
ROBOT = Robot(
    name="arm", command_low=np.array([-1, -2, -1], np.float32), command_high=np.array([1, 2, 1], np.float32),
    max_step=np.array([0.1, 0.2, 0.0], np.float32), initial_command=np.zeros(DIM, np.float32), cameras=(),
    image_height=1, image_width=1, num_proprio=2, is_simulated=True,
)  # fmt: skip

ANY_ROW = hnp.arrays(np.float32, DIM, elements=st.floats(width=32, allow_nan=False, allow_infinity=False))
COMMANDS = st.tuples(*(st.floats(-1, 1, width=32),) * DIM).map(lambda values: np.array(values, np.float32))


def gate(row: Any, last: Any = (0, 0, 0)) -> tuple[Floats | None, Hit]:
    return within_limits(np.array(row, np.float32), np.array(last, np.float32), ROBOT, None)


@given(row=ANY_ROW, last=COMMANDS)
def test_a_command_is_within_the_joint_limits(row: Floats, last: Floats) -> None:
    command, _ = within_limits(row, last, ROBOT, None)
    assert command is not None
    assert ((command >= ROBOT.command_low) & (command <= ROBOT.command_high)).all()


@given(row=ANY_ROW, last=COMMANDS)
def test_a_command_is_within_one_step_of_the_last(row: Floats, last: Floats) -> None:
    command, _ = within_limits(row, last, ROBOT, None)
    assert command is not None
    assert (np.abs(command - last)[:2] <= ROBOT.max_step[:2] + 1e-6).all()


@given(row=ANY_ROW, last=COMMANDS)
def test_a_command_passes_the_gate_unchanged(row: Floats, last: Floats) -> None:
    command, _ = within_limits(row, last, ROBOT, None)
    assert command is not None
    again, hit = within_limits(command, last, ROBOT, None)
    assert again is not None
    assert (again == command).all()
    assert hit == Hit.NONE


@given(row=ANY_ROW, last=COMMANDS)
def test_a_hit_is_told_exactly_when_the_row_was_changed(row: Floats, last: Floats) -> None:
    command, hit = within_limits(row, last, ROBOT, None)
    assert (hit != Hit.NONE) == (command != row).any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("position", range(DIM))
def test_a_row_that_is_not_finite_is_no_command(bad: float, position: int) -> None:
    row = np.zeros(DIM, np.float32)
    row[position] = bad
    assert within_limits(row, np.zeros(DIM, np.float32), ROBOT, None) == (None, Hit.NON_FINITE)


@pytest.mark.parametrize(
    ("row", "last", "hit"),
    [
        ((0, 0, 0), (0, 0, 0), Hit.NONE),
        ((0.5, 0, 0), (0, 0, 0), Hit.STEP),
        ((1.05, 0, 0), (0.95, 0, 0), Hit.JOINT),
        ((5, 0, 0), (0, 0, 0), Hit.JOINT | Hit.STEP),
        ((0, 0, 1), (0, 0, -1), Hit.NONE),
        ((0, 0, 3), (0, 0, -1), Hit.JOINT),
    ],
)
def test_a_row_tells_what_it_ran_into(row: Any, last: Any, hit: Hit) -> None:
    assert gate(row, last)[1] == hit


def test_no_step_limit_means_no_step_limit() -> None:
    command, _ = gate((0, 0, 1), (0, 0, -1))
    assert command is not None
    assert command[2] == 1.0


def test_the_gate_leaves_its_arguments_alone() -> None:
    row, last = np.full(DIM, 9, np.float32), np.zeros(DIM, np.float32)
    within_limits(row, last, ROBOT, None)
    assert (row == 9).all()
    assert (last == 0).all()
