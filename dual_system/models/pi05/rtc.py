"""Real-time chunking at inference (Black, Galliker and Levine 2025): a chunk that continues the one being played.

The flow is guided towards the previous chunk's unplayed rows: fully where they are committed, decaying after
them, not at all beyond the last of them. The guidance is a vector-Jacobian product through the network, so the
unguided rows stay consistent with the others. Flow time as in `flow`: t = 1 is noise; the paper's tau is 1 - t.
"""

# B batch, N horizon, A padded action dim

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dual_system.models import flow

MAX_WEIGHT = 5.0
"""The paper's beta: with few steps, larger guidance weights diverge."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Guide:
    """The guidance's target chunk and the weight of each of its entries."""

    target: Tensor
    """(B, N, A) normalised; arbitrary where the weight is 0"""
    weight: Tensor
    """(B, N, A) in [0, 1]"""
    max_weight: float = MAX_WEIGHT


def soft_mask(horizon: int, num_previous: int, num_committed: int) -> Tensor:
    """Returns W, (N,) float32: 1 for committed rows, decaying over the rest of the previous ones, 0 beyond.

    Raises:
        ValueError: not 0 <= num_committed <= num_previous <= horizon.
    """
    if not 0 <= num_committed <= num_previous <= horizon:
        raise ValueError(
            f"expected 0 <= committed <= previous <= {horizon} rows, came {num_committed} committed of {num_previous}"
        )
    row_N = torch.arange(horizon)
    fraction_N = ((num_previous - row_N) / (num_previous - num_committed + 1)).clamp(0.0, 1.0)
    decay_N = fraction_N * torch.expm1(fraction_N) / math.expm1(1.0)
    return torch.where(row_N < num_committed, torch.ones(horizon), decay_N)


def pull(time: float, max_weight: float = MAX_WEIGHT) -> float:
    """Returns the guidance weight at flow time t: (tau^2 + (1 - tau)^2) / (tau (1 - tau)), at most ``max_weight``."""
    tau = 1.0 - time
    odds = tau * time
    return min(max_weight, (tau**2 + time**2) / odds) if odds > 0.0 else max_weight


def guided(
    velocity_at: Callable[[int, Tensor], Tensor], guide: Guide, num_steps: int
) -> Callable[[int, Tensor], Tensor]:
    """Returns the guided velocity for `flow.euler`; ``velocity_at`` must be differentiable in x.

    Its tensors must not be inference tensors (`torch.inference_mode`): those cannot be differentiated through.
    """
    times = flow.euler_times(num_steps)

    def guided_at(index: int, x_BNA: Tensor) -> Tensor:
        time = times[index]
        with torch.enable_grad():
            x_BNA = x_BNA.detach().requires_grad_()
            velocity_BNA = velocity_at(index, x_BNA)
            reached_BNA = x_BNA - time * velocity_BNA
            miss_BNA = (guide.weight * (guide.target - reached_BNA)).detach()
            (correction_BNA,) = torch.autograd.grad(reached_BNA, x_BNA, miss_BNA)
        return velocity_BNA.detach() - pull(time, guide.max_weight) * correction_BNA

    return guided_at
