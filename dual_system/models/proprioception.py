"""What a small PONDER is told of the robot itself: two tokens behind every observation's pictures.

The paper's PONDER has pictures alone, of the wrist's camera too, and a pretrained eye that sees in them whether a cube
hangs between the fingers. From scratch, at 64 px, that is a matter of very few pixels, while the robot knows it. What
is told depends neither on where the tool is above the table nor on which side is which, so moved and mirrored pictures
(`training.augment`) need no other numbers.

Like carriers, the tokens are rows of the embedding table that no real token uses. Pure numpy.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dual_system.models.arm import NUM_ARM_JOINTS, tool_poses
from dual_system.models.grip import Grip, as_told

NUM_PROPRIO = NUM_ARM_JOINTS + 1
"""The Panda's: joint angles [rad], and the place of one finger [m], 0 closed."""
MAX_FINGER_M, MAX_HEIGHT_M = 0.04, 0.32
"""Of one finger, and of the tool above the table. What is beyond counts as the last bin."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Proprioception:
    """Which rows tell how far the gripper is open, and behind them which tell how high the tool is."""

    first_id: int
    num_finger_bins: int = 16
    num_height_bins: int = 32
    grip: Grip | None = None
    """None: fingers are told as they are."""

    def __post_init__(self) -> None:
        if min(self.num_finger_bins, self.num_height_bins) < 1 or self.first_id < 0:
            raise ValueError(f"{self}: bins are at least 1 and rows count from 0")

    @property
    def num_tokens(self) -> int:
        """Behind the pictures of one observation."""
        return 2

    @property
    def rows(self) -> range:
        """Of the embedding table."""
        return range(self.first_id, self.first_id + self.num_finger_bins + self.num_height_bins)

    def ids(self, proprio: ArrayLike) -> tuple[int, int]:
        """The tokens of a Panda's state (8,): its fingers', its tool's.

        Raises ValueError unless these are eight finite numbers.
        """
        state = np.asarray(proprio, np.float64)
        if state.shape != (NUM_PROPRIO,) or not np.isfinite(state).all():
            raise ValueError(f"proprio is {state}; PONDER reads {NUM_PROPRIO} finite numbers, 7 joints and a finger")
        state = as_told(state, self.grip)
        height_m = tool_poses(state[:NUM_ARM_JOINTS]).position_m[2]
        finger = _bin(state[-1] / MAX_FINGER_M, self.num_finger_bins)
        height = _bin(height_m / MAX_HEIGHT_M, self.num_height_bins)
        return self.first_id + finger, self.first_id + self.num_finger_bins + height


def check_rows(told: Proprioception, num_tokens: int, taken: Sequence[int]) -> None:
    """Raises ValueError if rows of real tokens, which come first, or ``taken`` ones are among its own."""
    clash = [row for row in taken if row in told.rows]
    if told.first_id < num_tokens or clash:
        whose = f"carriers {clash}" if clash else f"the tokenizer's first {num_tokens}"
        raise ValueError(f"proprioception takes rows {told.rows.start} to {told.rows.stop - 1}, some of them {whose}")


def _bin(share: float, num_bins: int) -> int:
    return min(max(int(share * num_bins), 0), num_bins - 1)
