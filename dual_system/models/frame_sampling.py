"""The frame memory's producer: which of its own past front pictures a POUNCE reads. Training and serving share it.

A history is one row of pictures on a grid: those of the demonstration, then those of the episode. Picture i counts as
step ``i * stride_ticks``: the demonstration is simply the first part of what was seen, and the episode's tick 0 follows
one stride after its last picture.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dual_system.models.ponder.demo_sampling import FASTEST_HZ, DemoSampling

FrameRule = Literal["spread", "newest"]
FrameEnd = Literal["observation", "query"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSampling:
    """Which pictures of a history are read.

    Raises:
        ValueError: fewer than two frames, or a stride that does not divide a second of 20 ticks.
    """

    num_frames: int = 32
    rule: FrameRule = "spread"
    """spread: evenly over the whole history, first and last included (FrameSamp). newest: the last ones, a window."""
    stride_ticks: int = 1
    """Distance of the grid; RoboMME's FrameSamp keeps every step."""
    until: FrameEnd = "observation"
    """What the newest picture may be of: POUNCE's own observation, or the one that its cognition is of (a delayed
    memory: as old as C would be, whether or not POUNCE reads any)."""

    def __post_init__(self) -> None:
        if self.num_frames < 2:
            raise ValueError(f"num_frames must be at least 2, came {self.num_frames}")
        if self.stride_ticks < 1 or FASTEST_HZ % self.stride_ticks:
            raise ValueError(f"stride_ticks must divide {FASTEST_HZ}, came {self.stride_ticks}")

    @property
    def demonstrations(self) -> DemoSampling:
        """Sampling of the demonstration's part of the grid."""
        return DemoSampling(hz=FASTEST_HZ // self.stride_ticks)

    def num_seen(self, num_demo: int, tick: int) -> int:
        """Length of the history at a tick of the episode, after ``num_demo`` pictures of a demonstration."""
        return num_demo + tick // self.stride_ticks + 1

    def indices(self, num_seen: int) -> list[int]:
        """Indices of the pictures to read of a history of this length, ascending; all if they are few."""
        if num_seen <= self.num_frames:
            return list(range(num_seen))
        if self.rule == "newest":
            return list(range(num_seen - self.num_frames, num_seen))
        return [place * (num_seen - 1) // (self.num_frames - 1) for place in range(self.num_frames)]

    def read(self, history: Mapping[int, NDArray[np.uint8]], num_seen: int) -> tuple["PastFrame", ...]:
        """The pictures to read, oldest first, without those that ``history`` lacks."""
        return tuple(
            PastFrame(step=index * self.stride_ticks, frame=history[index])
            for index in self.indices(num_seen)
            if index in history
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PastFrame:
    """A front picture of the past."""

    step: int
    """In control ticks since the history began."""
    frame: NDArray[np.uint8]
    """(h, w, 3)"""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameMemoryConfig:
    """FrameSamp+Modul's memory: its frames, and how the expert's layers read them (`pi05.modulation`)."""

    sampling: FrameSampling = FrameSampling()
    pooled_side: int = 4
    """A frame's patches are averaged to this many by as many tokens."""
    position_size: int = 768
    """Numbers that say a token's step and place: six blocks."""
    num_heads: int = 4
    head_dim: int = 256

    def __post_init__(self) -> None:
        if self.position_size < 12 or self.position_size % 6:
            raise ValueError(f"position_size must be six blocks of at least 2, came {self.position_size}")

    @property
    def tokens_per_frame(self) -> int:
        return self.pooled_side**2

    @property
    def num_tokens(self) -> int:
        """Slots of the memory, padding included."""
        return self.sampling.num_frames * self.tokens_per_frame

    def grid_side(self, num_patches: int) -> int:
        """Patches of a side of a picture. Raises ValueError if they cannot be averaged to ``pooled_side``."""
        side = isqrt(num_patches)
        if side * side != num_patches or side % self.pooled_side:
            raise ValueError(
                f"a picture's {num_patches} patches cannot be averaged to {self.pooled_side} x {self.pooled_side}"
            )
        return side
