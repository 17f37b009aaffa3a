"""What PONDER is told of the robot: the two things it says, and nothing about where on the table or on which side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.arm import tool_poses
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.context import IGNORE, ContextFormat, SegmentKind
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.proprioception import MAX_FINGER_M, MAX_HEIGHT_M, NUM_PROPRIO, Proprioception

TOLD = Proprioception(first_id=456)
HOME = np.array([0.0, 0.0, 0.0, -np.pi / 2, 0.0, np.pi / 2, np.pi / 4])
FORMAT = ContextFormat(
    vocabulary=Vocabulary.tiny(), num_carriers=2, first_carrier_id=448, image_grid=(1, 1), proprioception=TOLD
)
joints = st.lists(st.floats(-0.6, 0.6), min_size=7, max_size=7).map(lambda moves: HOME + np.array(moves))
fingers = st.floats(-0.01, 0.06)


@given(joints, fingers)
def test_the_tokens_are_the_bins_of_finger_and_height(joints_rad: np.ndarray, finger_m: float) -> None:
    finger, height = TOLD.ids([*joints_rad, finger_m])
    height_m = tool_poses(joints_rad).position_m[2]
    assert {finger, height} <= set(TOLD.rows)
    for token, first, share, num_bins in (
        (finger, 456, finger_m / MAX_FINGER_M, 16),
        (height, 456 + 16, height_m / MAX_HEIGHT_M, 32),
    ):
        number = token - first
        assert 0 <= number < num_bins
        assert number <= share * num_bins or number == 0
        assert share * num_bins < number + 1 or number == num_bins - 1


@given(joints, fingers, st.floats(-1.5, 1.5))
def test_it_does_not_tell_where_above_the_table_or_on_which_side(
    joints_rad: np.ndarray, finger_m: float, turn_rad: float
) -> None:
    turned = joints_rad + turn_rad * np.eye(7)[0]
    mirrored = joints_rad * np.array([-1, 1, -1, 1, -1, 1, -1])
    heights_m = [tool_poses(each).position_m[2] * 100 for each in (joints_rad, turned, mirrored)]
    if len({round(height, 6) // 1 for height in heights_m}) == 1:  # on the edge between two bins rounding decides
        assert len({TOLD.ids([*each, finger_m]) for each in (joints_rad, turned, mirrored)}) == 1


@pytest.mark.parametrize("state", [np.zeros(7), np.zeros((1, 8)), np.full(8, np.nan), [*HOME, np.inf]])
def test_what_is_no_state_is_refused(state: np.ndarray) -> None:
    with pytest.raises(ValueError, match="8 finite numbers"):
        TOLD.ids(state)


def test_an_observation_ends_with_them_and_nothing_of_it_is_learned() -> None:
    bare = replace(FORMAT, proprioception=None)
    told = FORMAT.observation(2, np.zeros(NUM_PROPRIO))
    assert told.ids == (*bare.observation(2).ids, *TOLD.ids(np.zeros(NUM_PROPRIO)))
    assert (told.kind, told.num_images) == (SegmentKind.OBSERVATION, 2)
    assert set(told.targets) == {IGNORE}
    assert bare.observation(2, np.zeros(NUM_PROPRIO)) == bare.observation(2)
    assert FORMAT.demo(2) == bare.demo(2)
    with pytest.raises(ValueError, match="reads the robot's state"):
        FORMAT.observation(2)


@pytest.mark.parametrize(("first_id", "whose"), [(400, "tokenizer"), (449, r"carriers \[449\]"), (432, "carriers")])
def test_rows_that_are_taken_are_refused(first_id: int, whose: str) -> None:
    with pytest.raises(ValueError, match=whose):
        replace(FORMAT, proprioception=Proprioception(first_id=first_id))


def test_rows_beyond_the_embedding_table_are_refused() -> None:
    with pytest.raises(ValueError, match="vocab_size is 512"):
        replace(tiny_cpu(), proprioception=Proprioception(first_id=480))
