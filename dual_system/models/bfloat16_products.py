"""Linear layers that multiply in bfloat16 while all else stays float32: weights, their gradients, norms, attention.

On CPUs with bfloat16 products these take a third of the time. autocast would do the same to attention, whose way back
is several times slower in bfloat16 on a CPU, and would hand bfloat16 on to whatever comes next.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor, nn


class _Product(torch.autograd.Function):
    """x W^T, and its two products on the way back."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor) -> Tensor:
        rows, narrow = x.reshape(-1, x.shape[-1]).bfloat16(), weight.bfloat16()
        ctx.save_for_backward(rows, narrow)
        ctx.shape = x.shape
        return (rows @ narrow.t()).float().view(*x.shape[:-1], -1)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        rows, narrow = ctx.saved_tensors
        grad_rows = grad.reshape(-1, grad.shape[-1]).bfloat16()
        wants_x, wants_weight = ctx.needs_input_grad
        of_x = (grad_rows @ narrow).float().view(ctx.shape) if wants_x else None
        of_weight = (grad_rows.t() @ rows).float() if wants_weight else None
        return of_x, of_weight


class Bfloat16Linear(nn.Linear):
    """float32 in, float32 out, float32 weights; the product alone is bfloat16's."""

    def forward(self, input: Tensor) -> Tensor:
        product = cast(Tensor, _Product.apply(input, self.weight))  # type: ignore[no-untyped-call]
        return product if self.bias is None else product + self.bias


def multiply_in_bfloat16(model: nn.Module, *, least_size: int = 64) -> None:
    """From now on all linear layers of ``model`` do so, in place, whose both sides are at least so large.

    Names, weights and their dtype stay, so a checkpoint does not know.

    Raises:
        ValueError: a weight is not float32.
    """
    for name, module in model.named_modules():
        if type(module) is nn.Linear and min(module.weight.shape) >= least_size:
            if module.weight.dtype != torch.float32:
                raise ValueError(f"{name} is {module.weight.dtype}; products are narrowed for float32 weights only")
            module.__class__ = Bfloat16Linear
