"""Starts beside the way: the tool is somewhere else than recorded, and the commands bring it back.

In recorded episodes the tool is nearly always where the plan has it. A policy then learns to go on from where it is,
straight down onto nothing, instead of to where cognition points; measured, see docs/training.md. In tool deltas a
displaced start needs no new episode: the commanded poses stay, and what is relative to the tool moves with it.
"""

# I invocations, N rows, A padded action dim

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dual_system.models.action_space import states_in
from dual_system.models.normalisation import Floats, RobotStatistics

_GRIP_CHANGE = 0.5  # of a command from -1, closed, to 1, open
_TOUCH_M, _FREE_M = 0.03, 0.13  # heights of the tool between which nudges grow from nothing, as the DART noise does


@dataclass(frozen=True, slots=True, kw_only=True)
class Nudge:
    """How far the start is moved, and how fast the commands are back on the way."""

    std_m: float = 0.0
    """Of each horizontal direction, high above the table; 0: starts are as recorded."""
    return_rows: int = 8
    """Rows until the commands are the recorded ones again, in equal steps."""
    spares_release: bool = False
    """Starts stay as recorded where the gripper is told to open or close before that: a hand that is moved aside there
    learns to let go where it is."""

    def __post_init__(self) -> None:
        if self.std_m < 0 or self.return_rows < 1:
            raise ValueError(f"std_m must be at least 0 and return_rows at least 1, came {self}")


NO_NUDGE = Nudge()


def draw_nudges(nudge: Nudge, states_I8: Floats, chunks_IN8: Floats, rng: np.random.Generator) -> Floats:
    """Returns horizontal displacements (I, 2) [m] of the tool at these states, from which these commands go on."""
    height_I = states_in("ee_delta", states_I8)[:, 2]
    share_I = ((height_I - _TOUCH_M) / (_FREE_M - _TOUCH_M)).clip(0.0, 1.0)
    if nudge.spares_release:
        grip_IN = chunks_IN8[:, : nudge.return_rows + 1, 7]
        share_I = np.where(np.ptp(grip_IN, axis=1) > _GRIP_CHANGE, 0.0, share_I)
    return (rng.normal(0.0, nudge.std_m, (len(states_I8), 2)) * share_I[:, None]).astype(np.float32)


def apply_nudges(
    nudge: Nudge, nudges_I2: Floats, state_IS: Tensor, actions_INA: Tensor, statistics: RobotStatistics
) -> tuple[Tensor, Tensor]:
    """Returns normalised states and actions of starts that are displaced.

    Raises:
        ValueError: the network does not act in tool deltas.
    """
    if statistics.space != "ee_delta":
        raise ValueError(
            f"starts are nudged in the action space 'ee_delta', these statistics are of {statistics.space!r}"
        )
    num_rows = actions_INA.shape[1]
    back_N = np.minimum((np.arange(num_rows) + 1) / nudge.return_rows, 1.0)  # what the commands have caught up by then
    reach_N = np.array(statistics.reach) if statistics.reach else np.ones(num_rows)
    moved_IN2 = -nudges_I2[:, None] * (back_N / reach_N[:num_rows])[:, None]
    state_IS, actions_INA = state_IS.clone(), actions_INA.clone()
    state_IS[:, :2] += torch.from_numpy(nudges_I2 * _scale(statistics.state.q01, statistics.state.q99)).float()
    actions_INA[..., :2] += torch.from_numpy(moved_IN2 * _scale(statistics.action.q01, statistics.action.q99)).float()
    return state_IS, actions_INA


def _scale(low: tuple[float, ...], high: tuple[float, ...]) -> Floats:
    """Normalised numbers to a metre, of x and y."""
    return (2.0 / (np.array(high[:2]) - np.array(low[:2]))).astype(np.float32)
