"""Linear layers with a byte a weight, each output row under a scale of its own: what int8 and fp8 share.

Weights are widened as a layer is called, which costs about what reading them as floats would. Which layers of a model
are narrow is the business of who serves it.
"""

# O output rows, I input columns

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class NarrowLinear(nn.Module, ABC):
    """`nn.Linear` over narrow weights. How they are narrowed is the subclass's."""

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
        """Float32 rows as numbers of a byte, and the scale (R) float32 that widens each row again."""

    def product(self, x: Tensor) -> Tensor:
        """``x`` times the weight, without the bias."""
        return F.linear(x, self.weight_OI.to(x.dtype)) * self.scale_O.to(x.dtype)

    def forward(self, x: Tensor) -> Tensor:
        out = self.product(x)
        return out if self.bias is None else out + self.bias.to(x.dtype)


def row_scale(exact_RI: Tensor, most: float) -> Tensor:
    """(R) float32 under which every row's largest weight becomes ``most``. A row of zeros has one as well."""
    return (exact_RI.abs().amax(dim=1) / most).clamp(min=torch.finfo(torch.float32).tiny)


def quantise_where(
    model: nn.Module, is_narrow: Callable[[str], bool], narrowed: Callable[[nn.Linear], NarrowLinear]
) -> int:
    """Replaces linear layers in place, those whose weight has such a name; returns how many bytes that saved."""
    saved = 0
    for name, module in list(model.named_modules()):
        for child_name, child in list(module.named_children()):
            if type(child) is nn.Linear and is_narrow(f"{name}.{child_name}.weight"):
                saved += child.weight.numel() * (child.weight.element_size() - 1)
                setattr(module, child_name, narrowed(child))
    return saved
