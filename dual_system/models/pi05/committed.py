"""Real-time chunking learned in training (Black et al. 2025, "Training-Time Action Conditioning"): rows that are given.

The first rows of a chunk will be played by the chunk before, whatever this one says: as many as an invocation takes
ticks. The network is told them. They enter the flow as data, at flow time 0 ("done"; the paper's tau is 1 - t), while
the others run from noise at the step's own time; the loss counts the others only. So the chunk continues what is being
played without the backward pass per step of `rtc`, by a network that was trained with rows given.

A row's flow time is one of two, hence so are its styles: both are made once for the batch and chosen row by row.
"""

# B batch, N horizon, A padded action dim, M norms of the expert, E expert width

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

DONE = 0.0
"""Flow time of data."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Committed:
    """The rows that are given, and which these are."""

    rows: Tensor
    """(B, N, A) normalised; anything where none is given"""
    is_given: Tensor
    """(B, N) bool: the first so many of each sample"""

    def over(self, x_BNA: Tensor) -> Tensor:
        """``x_BNA`` with the given rows in their places."""
        return torch.where(self.is_given[..., None], self.rows, x_BNA)


def first_rows(count_B: Tensor, horizon: int) -> Tensor:
    """Returns (B, N) bool: the first ``count_B`` rows of each sample.

    Raises:
        ValueError: a count is negative, or leaves no row to be made.
    """
    if len(count_B) and not 0 <= int(count_B.min()) <= int(count_B.max()) < horizon:
        raise ValueError(f"expected 0..{horizon - 1} committed rows of {horizon}, came {count_B.tolist()}")
    return torch.arange(horizon, device=count_B.device) < count_B[:, None]


def draw_counts(count: int, max_rows: int, generator: torch.Generator) -> Tensor:
    """Draws how many rows training gives each sample, (count,) int64, uniform in 0..max_rows.

    None at all is among them: the first chunk of an episode has nothing to continue.
    """
    return torch.randint(max_rows + 1, (count,), generator=generator)


def row_styles(styles_M3B1E: Tensor, done_M3B1E: Tensor, is_given_BN: Tensor) -> Tensor:
    """Returns (M, 3, B, N, E): ``done_M3B1E`` for the given rows, the step's for the rest."""
    return torch.where(is_given_BN[None, None, :, :, None], done_M3B1E, styles_M3B1E)


def pinned(velocity_at: Callable[[int, Tensor], Tensor], committed: Committed) -> Callable[[int, Tensor], Tensor]:
    """Returns a velocity for `flow.euler` that leaves the given rows where they are; start from `Committed.over`."""

    def pinned_at(index: int, x_BNA: Tensor) -> Tensor:
        return velocity_at(index, x_BNA).masked_fill(committed.is_given[..., None], 0.0)

    return pinned_at
