"""Weight-only int8: a quarter of float32's memory, for CPUs; products are computed in floating point.

Each output row's scale is its largest weight / 127.
"""

# R rows of weights, I input columns

import torch
from torch import Tensor

from dual_system.models.narrow_linear import NarrowLinear, row_scale

_MOST = 127


class Int8Linear(NarrowLinear):
    """`nn.Linear` over int8 weights."""

    @staticmethod
    def narrowed(exact_RI: Tensor) -> tuple[Tensor, Tensor]:
        scale_R = row_scale(exact_RI, _MOST)
        return (exact_RI / scale_R[:, None]).round().to(torch.int8), scale_R
