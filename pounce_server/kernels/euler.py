"""The end of a flow step: the action projection's bias, then the Euler step."""

# R rows (batch times horizon), A padded action dim

from __future__ import annotations

import torch
from torch import Tensor

from dual_system.models.kernels.launch import Tolerance, block_size, check_tensor, kernel, tl

TOLERANCE = {torch.float32: Tolerance(rtol=1e-6, atol=1e-6)}  # actions and velocities are float32 in every precision


def euler_eager(x_RA: Tensor, velocity_RA: Tensor, bias_A: Tensor, num_steps: int) -> None:
    """Adds the bias to ``velocity_RA``, then subtracts a step of it from ``x_RA``; both in place."""
    velocity_RA += bias_A
    x_RA -= velocity_RA / num_steps


def euler_fused(x_RA: Tensor, velocity_RA: Tensor, bias_A: Tensor, num_steps: int) -> None:
    """`euler_eager` in one launch.

    Raises:
        ValueError: a tensor is not float32 or not contiguous, or shapes do not match.
    """
    num_rows, action_dim = x_RA.shape
    check_tensor("x", x_RA, (num_rows, action_dim), torch.float32)
    check_tensor("velocity", velocity_RA, (num_rows, action_dim), torch.float32)
    check_tensor("bias", bias_A, (action_dim,), torch.float32)
    _euler[(num_rows,)](x_RA, velocity_RA, bias_A, WIDTH=action_dim, BLOCK=block_size(action_dim), STEPS=num_steps)


@kernel
def _euler(
    x_ptr: tl.tensor,
    velocity_ptr: tl.tensor,
    bias_ptr: tl.tensor,
    WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
    STEPS: tl.constexpr,
) -> None:
    column = tl.arange(0, BLOCK)
    is_inside = column < WIDTH
    at = tl.program_id(0).to(tl.int64) * WIDTH + column
    bias = tl.load(bias_ptr + column, mask=is_inside, other=0.0)
    velocity = tl.load(velocity_ptr + at, mask=is_inside, other=0.0) + bias
    tl.store(velocity_ptr + at, velocity, mask=is_inside)
    x = tl.load(x_ptr + at, mask=is_inside, other=0.0)
    tl.store(x_ptr + at, x - velocity / STEPS, mask=is_inside)
