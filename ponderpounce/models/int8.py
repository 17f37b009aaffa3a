"""Weight-only int8: a quarter of the memory, for CPUs; the products themselves stay floating.

Each output row has its own scale, its largest weight / 127. Weights are widened as a layer is called, which costs about
what reading them as floats would. Which layers are narrow is the business of who serves them.
"""

# O output rows, I input columns

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

_MOST = 127


class Int8Linear(nn.Module):
    """`nn.Linear` over int8 weights."""

    weight_OI: Tensor
    scale_O: Tensor

    def __init__(self, linear: nn.Linear) -> None:
        super().__init__()
        exact_OI = linear.weight.detach().float()
        scale_O = exact_OI.abs().amax(dim=1).clamp(min=torch.finfo(torch.float32).tiny) / _MOST
        self.register_buffer("weight_OI", (exact_OI / scale_O[:, None]).round().to(torch.int8))
        self.register_buffer("scale_O", scale_O)
        self.bias = linear.bias

    def forward(self, x: Tensor) -> Tensor:
        out = F.linear(x, self.weight_OI.to(x.dtype)) * self.scale_O.to(x.dtype)
        return out if self.bias is None else out + self.bias.to(x.dtype)


def quantise_where(
    model: nn.Module, is_narrow: Callable[[str], bool], narrowed: Callable[[nn.Linear], nn.Module] = Int8Linear
) -> int:
    """Replaces linear layers in place, those whose weight has such a name; returns how many bytes that saved.

    ``narrowed`` makes of each a layer with a byte a weight.
    """
    saved = 0
    for name, module in list(model.named_modules()):
        for child_name, child in list(module.named_children()):
            if type(child) is nn.Linear and is_narrow(f"{name}.{child_name}.weight"):
                saved += child.weight.numel() * (child.weight.element_size() - 1)
                setattr(module, child_name, narrowed(child))
    return saved
