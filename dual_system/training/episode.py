"""A recorded episode as training data."""

# T ticks, S numbers of a state, A of an action

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]  # (height, width, 3) RGB
Frame = NDArray[np.uint8 | np.float16]
"""A picture, or the tokens (S, W) that a frozen tower makes of it (`frozen_towers`)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrainingEpisode:
    """Training data of an episode of T ticks. Row k is the state before action k.

    Raises:
        ValueError: the columns differ in length, or ``imitated_from`` is none of the ticks.
    """

    instruction: str
    demo: tuple[tuple[Frame, ...], ...]
    """PONDER's images, per sampled instant of the demonstration; () without one."""
    images: Sequence[tuple[Frame, ...]]
    """PONDER's images (`ObservationReader.images`), per tick; empty tuples if PONDER is not run."""
    views: Sequence[tuple[Frame, ...]]
    """POUNCE's views in the order of the robot's cameras, per tick; empty tuples if POUNCE reads none."""
    state_TS: NDArray[np.float32]
    action_TA: NDArray[np.float32]
    """What was commanded, in the robot's units; the Panda's are absolute joint targets and the gripper's command."""
    subgoals: Sequence[str]
    """T grounded texts; empty texts for data without annotations."""
    is_transition_T: NDArray[np.bool_]
    """True where another subgoal begins. Texts do not show it: two in a row may be equal, and one changes when its
    object comes into view."""
    reasoning: str = ""
    """PONDER's target text at the first transition after a demonstration; empty without one."""
    imitated_from: int = 0
    """The tick from which POUNCE imitates; before it a policy acted (`pp-collect correct`, DAgger)."""
    history: Sequence[Frame] = ()
    """POUNCE's front pictures on the grid of its frame memory, the demonstration's first (`FrameSampling`)."""
    num_demo_history: int = 0
    """How many of these are the demonstration's."""
    seen_at_T: NDArray[np.intp] | None = None
    """For each tick, the tick at which its picture was taken (`as_seen`); None: the same tick."""

    def __post_init__(self) -> None:
        columns = (self.images, self.views, self.state_TS, self.action_TA, self.subgoals, self.is_transition_T)
        sizes = {len(column) for column in columns}
        if len(sizes) != 1 or 0 in sizes:
            raise ValueError(
                "an episode needs images, views, state, action, text and transition flag per tick; it has "
                f"{', '.join(str(len(column)) for column in columns)}"
            )
        if not 0 <= self.imitated_from < self.num_ticks:
            raise ValueError(f"imitated_from {self.imitated_from} is none of the {self.num_ticks} ticks")

    @property
    def num_ticks(self) -> int:
        return len(self.subgoals)

    @property
    def transition_ticks(self) -> frozenset[int]:
        """Ticks at which another subgoal begins."""
        return frozenset(np.flatnonzero(self.is_transition_T).tolist())

    def as_seen(self, seen_at_T: NDArray[np.intp]) -> TrainingEpisode:
        """The same episode with pictures taken at some ticks only: tick t has the picture of ``seen_at_T[t]``.

        PONDER's texts are taken from that tick too: if its pictures lagged behind its texts, PONDER would learn to
        ignore them. POUNCE's states and commands stay. Transitions without a picture in between become one.
        """
        count_T = np.cumsum(self.is_transition_T)[seen_at_T]
        return replace(
            self,
            subgoals=[self.subgoals[tick] for tick in seen_at_T],
            is_transition_T=np.diff(count_T, prepend=0) > 0,
            seen_at_T=seen_at_T,
        )

    def ponder_state(self, tick: int) -> NDArray[np.float32]:
        """The robot's state (S,) when the picture of this tick was taken."""
        state_S: NDArray[np.float32] = self.state_TS[tick if self.seen_at_T is None else self.seen_at_T[tick]]
        return state_S
