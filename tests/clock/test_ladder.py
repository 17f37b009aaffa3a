"""What is commanded when there is nothing good to command."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock.ladder import Ladder
from protocol.messages import Floats, Level, Schedule

HOLD_LIMIT, DECELERATE = 4, 5  # as in the schedule of conftest
P, S, H, D, X = Level.PLAY, Level.STALE, Level.HOLD, Level.DECELERATE, Level.STOPPED
ROW = np.array([1, 2, 1], np.float32)
LAST = np.array([0.5, 0.5, -1], np.float32)
STANDING = np.array([0, 0.25, -1], np.float32)

fresh, stale, nothing, engage = "fresh", "stale", "nothing", "engage"


@pytest.fixture
def ladder(timing: Callable[..., Schedule]) -> Ladder:
    return Ladder(timing())


def climb(ladder: Ladder, moves: list[str]) -> list[Level]:
    levels = []
    for move in moves:
        if move == engage:
            ladder.engage()
        else:
            ladder.step(ROW if move != nothing else None, move == stale, LAST, STANDING)
            levels.append(ladder.level)
    return levels


@pytest.mark.parametrize(
    ("moves", "levels"),
    [
        ([fresh], [P]),
        ([stale], [S]),
        ([fresh, stale, fresh], [P, S, P]),
        ([nothing] * 30, [H] * 30),  # before the first row there is nothing to have lost
        ([nothing, fresh], [H, P]),
        ([fresh, *[nothing] * 4], [P, H, H, H, H]),
        ([fresh, *[nothing] * 4, fresh], [P, H, H, H, H, P]),
        ([fresh, *[nothing] * 3, fresh, *[nothing] * 4], [P, H, H, H, P, H, H, H, H]),
        ([fresh, *[nothing] * 5], [P, H, H, H, H, D]),
        ([fresh, *[nothing] * 10], [P, H, H, H, H, D, D, D, D, X, X]),
        ([fresh, *[nothing] * 5, fresh], [P, H, H, H, H, D, D]),
        ([fresh, *[nothing] * 9, fresh, stale], [P, H, H, H, H, D, D, D, D, X, X, X]),
        ([fresh, *[nothing] * 9, engage, fresh], [P, H, H, H, H, D, D, D, D, X, P]),
        ([fresh, *[nothing] * 5, engage, nothing, fresh], [P, H, H, H, H, D, H, P]),
        ([fresh, *[nothing] * 9, engage, *[nothing] * 5], [P, H, H, H, H, D, D, D, D, X, H, H, H, H, D]),
    ],
)
def test_the_ladder(ladder: Ladder, moves: list[str], levels: list[Level]) -> None:
    assert climb(ladder, moves) == levels


MOVES = st.lists(st.sampled_from([fresh, stale, nothing, nothing, nothing, engage]), max_size=60)


@given(moves=MOVES)
def test_a_command_is_a_row_the_last_command_or_between_it_and_the_joints(
    timing: Callable[..., Schedule], moves: list[str]
) -> None:
    ladder, last = Ladder(timing()), LAST
    line: Floats | None = None
    for move in moves:
        if move == engage:
            ladder.engage()
            continue
        was = ladder.level
        command = ladder.step(ROW if move != nothing else None, False, last, STANDING)
        if ladder.level == Level.PLAY:
            expected = (command == ROW).all()
        elif ladder.level == Level.HOLD:
            expected = (command == last).all()
        else:
            line = last if was == Level.HOLD else line  # where slowing down began
            assert line is not None
            target = STANDING
            expected = (command >= np.minimum(line, target)).all() and (command <= np.maximum(line, target)).all()
        assert expected
        last = command


@given(moves=MOVES)
def test_nothing_but_engage_ends_a_stop(timing: Callable[..., Schedule], moves: list[str]) -> None:
    ladder = Ladder(timing())
    climb(ladder, [fresh, *[nothing] * 5])
    assert set(climb(ladder, [move for move in moves if move != engage])) <= {D, X}


def test_slowing_down_ends_at_the_measured_joints(ladder: Ladder) -> None:
    climb(ladder, [fresh, *[nothing] * HOLD_LIMIT])
    commands = [ladder.step(None, False, LAST, STANDING) for _ in range(DECELERATE)]
    assert commands[-1] == pytest.approx(STANDING)


def test_slowing_down_is_a_straight_line(ladder: Ladder) -> None:
    climb(ladder, [fresh, *[nothing] * HOLD_LIMIT])
    commands = np.stack([LAST, *(ladder.step(None, False, LAST, STANDING) for _ in range(DECELERATE))])
    assert np.diff(commands, n=2, axis=0) == pytest.approx(0, abs=1e-6)


def test_the_gripper_keeps_what_it_holds(ladder: Ladder) -> None:
    climb(ladder, [fresh, *[nothing] * HOLD_LIMIT])
    assert {ladder.step(None, False, LAST, STANDING)[-1] for _ in range(DECELERATE + 3)} == {LAST[-1]}


def test_later_joints_do_not_move_the_end_of_the_line(ladder: Ladder) -> None:
    """The joints measured when slowing down began: a robot that is pushed is not followed."""
    climb(ladder, [fresh, *[nothing] * (HOLD_LIMIT + 1)])
    for _ in range(DECELERATE - 1):
        command = ladder.step(None, False, LAST, STANDING + 1)
    assert command[:2] == pytest.approx(STANDING[:2])
