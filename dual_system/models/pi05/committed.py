"""Real-time chunking learned in training (Black et al. 2025, "Training-Time Action Conditioning"): committed rows.

While an invocation computes, the previous chunk plays on, so the new chunk's first rows are already committed to its
actions. The network is conditioned on them: they enter the flow as data, at flow time 0 ("done"; the paper's tau is
1 - t), while the other rows run from noise at the step's own time; the loss counts the other rows only. So the chunk
continues the motion without `rtc`'s backward pass per step, but the network must have been trained this way.

A row has one of two flow times, hence one of two styles: both are computed once per batch and selected per row.
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
    """The committed rows of a chunk, and the mask that marks them."""

    rows: Tensor
    """(B, N, A) normalised; arbitrary where ``is_given`` is False"""
    is_given: Tensor
    """(B, N) bool: True for a sample's first rows"""

    def over(self, x_BNA: Tensor) -> Tensor:
        """``x_BNA`` with the committed rows written over its own."""
        return torch.where(self.is_given[..., None], self.rows, x_BNA)


def first_rows(count_B: Tensor, horizon: int) -> Tensor:
    """Returns (B, N) bool: the first ``count_B`` rows of each sample.

    Raises:
        ValueError: a count is negative, or leaves no row to generate.
    """
    if len(count_B) and not 0 <= int(count_B.min()) <= int(count_B.max()) < horizon:
        raise ValueError(f"expected 0..{horizon - 1} committed rows of {horizon}, came {count_B.tolist()}")
    return torch.arange(horizon, device=count_B.device) < count_B[:, None]


def draw_counts(count: int, max_rows: int, generator: torch.Generator) -> Tensor:
    """Draws the number of committed rows of each training sample, (count,) int64, uniform in 0..max_rows.

    0 is included: the first chunk of an episode has nothing to continue.
    """
    return torch.randint(max_rows + 1, (count,), generator=generator)


def row_styles(styles_M3B1E: Tensor, done_M3B1E: Tensor, is_given_BN: Tensor) -> Tensor:
    """Returns (M, 3, B, N, E): ``done_M3B1E`` for the committed rows, the step's styles for the rest."""
    return torch.where(is_given_BN[None, None, :, :, None], done_M3B1E, styles_M3B1E)


def pinned(velocity_at: Callable[[int, Tensor], Tensor], committed: Committed) -> Callable[[int, Tensor], Tensor]:
    """Returns a velocity for `flow.euler` that keeps the committed rows fixed; start from `Committed.over`."""

    def pinned_at(index: int, x_BNA: Tensor) -> Tensor:
        return velocity_at(index, x_BNA).masked_fill(committed.is_given[..., None], 0.0)

    return pinned_at
