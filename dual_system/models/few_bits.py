"""What matrices differ by from those they began as, in few bits a number.

Layers that go on from layers that are there already differ from them by little: of the shipped reader's matrices the
difference has 3 % of the norm in the median, and numbers of much the same size: whole weights in 8 bits would lose more
of it. So every row of a difference has a step, and the difference is an odd number of half steps: with 2
bits -1.5, -0.5, 0.5 or 1.5. The step is the one with which so many levels lose least of normally distributed numbers
(Max, Quantizing for minimum distortion, 1960, table II). While it learns, `rounded` lets the gradient through
(straight-through estimator, Bengio et al., arXiv:1308.3432), so that it learns what will be stored.

# R rows, C columns (all but a tensor's first axis), P bytes of a row, b bits
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

STEP_OF_STD = {2: 0.9957, 3: 0.5860, 4: 0.3352, 5: 0.1881}
"""How long a step is, by the number of bits."""


class FewBits(NamedTuple):
    """A difference as it is stored."""

    codes_RP: Tensor
    """uint8; a row's numbers one after the other, each from its lowest bit on, then zeros to the end of a byte."""
    steps_R: Tensor
    """float16."""


def narrowed(difference: Tensor, bits: int) -> FewBits:
    """A tensor (R, ...) in few bits.

    Raises:
        ValueError: there is no such number of bits, or the tensor is a vector, which stays as it is.
    """
    levels_RC, steps_R = _levels(difference, bits)
    codes_RC = (levels_RC + 2 ** (bits - 1)).to(torch.int32)
    bits_RN = (codes_RC[..., None] >> torch.arange(bits) & 1).flatten(1)
    bits_RP8 = F.pad(bits_RN, (0, -bits_RN.shape[1] % 8)).unflatten(1, (-1, 8))
    return FewBits((bits_RP8 << torch.arange(8)).sum(dim=-1).to(torch.uint8), steps_R)


def widened(few: FewBits, shape: tuple[int, ...], bits: int) -> Tensor:
    """The difference that was `narrowed`, float32 of this ``shape``."""
    bits_RN = (few.codes_RP[..., None].to(torch.int32) >> torch.arange(8) & 1).flatten(1)
    num_columns = torch.Size(shape[1:]).numel()
    codes_RC = (bits_RN[:, : num_columns * bits].unflatten(1, (-1, bits)) << torch.arange(bits)).sum(dim=-1)
    return _value(codes_RC.float() - 2 ** (bits - 1), few.steps_R).reshape(shape)


def rounded(difference: Tensor, bits: int) -> Tensor:
    """What `widened` makes of it `narrowed`, to the bit; its gradient is the difference's.

    Raises:
        ValueError: as `narrowed`.
    """
    value = _value(*_levels(difference, bits)).reshape(difference.shape)
    return value + (difference - difference.detach())


def shape_of_codes(shape: tuple[int, ...], bits: int) -> tuple[int, int]:
    """(R, P) of a tensor of this ``shape``."""
    return shape[0], -(-torch.Size(shape[1:]).numel() * bits // 8)


@torch.no_grad()
def _levels(difference: Tensor, bits: int) -> tuple[Tensor, Tensor]:
    """Whole numbers from -2^(b-1) to 2^(b-1) - 1, each telling the half step above it; and every row's step."""
    if bits not in STEP_OF_STD:
        raise ValueError(f"{bits} bits: a difference is stored in {', '.join(map(str, STEP_OF_STD))}")
    if difference.ndim == 1:
        raise ValueError(f"a vector of {len(difference)} is stored as it is; matrices are narrowed")
    difference_RC = difference.float().flatten(1)
    steps_R = (STEP_OF_STD[bits] * difference_RC.square().mean(dim=1).sqrt()).half()
    divisors_R = steps_R.float().where(steps_R != 0, 1)  # a row that has not moved has no step: any level is zero
    half = 2 ** (bits - 1)
    return (difference_RC / divisors_R[:, None]).floor().clamp(-half, half - 1), steps_R


def _value(levels_RC: Tensor, steps_R: Tensor) -> Tensor:
    return (levels_RC + 0.5) * steps_R.float()[:, None]
