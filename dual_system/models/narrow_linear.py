"""Linear layers with one byte per weight and one scale per output row: the common part of int8 and fp8.

Weights are widened when a layer is called, which costs about as much as reading float weights. The servers decide
which layers of a model are narrow.
"""

# O output rows, I input columns

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class NarrowLinear(nn.Module, ABC):
    """`nn.Linear` over narrow weights; the subclass defines how to narrow them."""

    weight_OI: Tensor
    scale_O: Tensor

    def __init__(self, linear: nn.Linear) -> None:
        super().__init__()
        weight_OI, scale_O = self.narrowed(linear.weight.detach().float())
        self.register_buffer("weight_OI", weight_OI)
        self.register_buffer("scale_O", scale_O)
        self.bias = linear.bias

    @staticmethod
    @abstractmethod
    def narrowed(exact_RI: Tensor) -> tuple[Tensor, Tensor]:
        """Returns float32 rows as one-byte numbers, and each row's scale (R,) float32 for widening."""

    def product(self, x: Tensor) -> Tensor:
        """``x`` times the weight, without the bias."""
        return F.linear(x, self.weight_OI.to(x.dtype)) * self.scale_O.to(x.dtype)

    def forward(self, x: Tensor) -> Tensor:
        out = self.product(x)
        return out if self.bias is None else out + self.bias.to(x.dtype)


def row_scale(exact_RI: Tensor, most: float) -> Tensor:
    """Scales (R,) float32 that map every row's largest weight to ``most``; positive for a row of zeros too."""
    return (exact_RI.abs().amax(dim=1) / most).clamp(min=torch.finfo(torch.float32).tiny)


def quantise_where(
    model: nn.Module, is_narrow: Callable[[str], bool], narrowed: Callable[[nn.Linear], NarrowLinear]
) -> int:
    """Replaces in place the linear layers whose weight's name satisfies ``is_narrow``; returns the bytes saved."""
    saved = 0
    for name, module in list(model.named_modules()):
        for child_name, child in list(module.named_children()):
            if type(child) is nn.Linear and is_narrow(f"{name}.{child_name}.weight"):
                saved += child.weight.numel() * (child.weight.element_size() - 1)
                setattr(module, child_name, narrowed(child))
    return saved
