"""Muon, for CPUs too: torch's own orthogonalises in bfloat16 wherever it runs.

On a CPU without bfloat16 products that was the largest part of a small network's step (docs/training.md, "How fast").
Here matrices of one shape go together, in float32 on a CPU and in bfloat16 elsewhere. Otherwise it is
`torch.optim.Muon` with ``adjust_lr_fn="match_rms_adamw"``, and a test holds it to that.
"""

# M matrices of R rows and K columns, R no more than K

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

_QUINTIC = (3.4445, -4.7750, 2.0315)
_ROUNDS = 5
_EPS = 1e-7
_AS_LONG_AS_ADAMW = 0.2  # arXiv:2502.16982, 2.2


class Muon(torch.optim.Optimizer):
    """Momentum with Nesterov's look ahead, each matrix's made orthogonal (K. Jordan et al., 2024)."""

    def __init__(
        self, params: Iterable[nn.Parameter], *, lr: float = 1e-3, weight_decay: float = 0.1, momentum: float = 0.95
    ) -> None:
        """Raises ValueError for a parameter that is no matrix."""
        super().__init__(params, {"lr": lr, "weight_decay": weight_decay, "momentum": momentum})
        for parameter in (each for group in self.param_groups for each in group["params"]):
            if parameter.ndim != 2:
                raise ValueError(f"Muon turns matrices, came a parameter of shape {tuple(parameter.shape)}")

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """One update of every parameter that has a gradient; ``closure`` is not called."""
        for group in self.param_groups:
            alike: defaultdict[tuple[Any, ...], list[nn.Parameter]] = defaultdict(list)
            for parameter in group["params"]:
                if parameter.grad is not None:
                    alike[tuple(parameter.shape), parameter.dtype, parameter.device].append(parameter)
            for parameters in alike.values():
                ahead = [self._looked_ahead(parameter, group["momentum"]) for parameter in parameters]
                reach = _AS_LONG_AS_ADAMW * math.sqrt(max(parameters[0].shape))
                for parameter, turned in zip(parameters, orthogonal(torch.stack(ahead)), strict=True):
                    parameter.mul_(1 - group["lr"] * group["weight_decay"])
                    parameter.add_(turned.to(parameter.dtype), alpha=-group["lr"] * reach)

    def _looked_ahead(self, parameter: nn.Parameter, momentum: float) -> Tensor:
        gradient, state = parameter.grad, self.state[parameter]
        assert gradient is not None
        if "momentum_buffer" not in state:
            state["momentum_buffer"] = torch.zeros_like(gradient)
        buffer: Tensor = state["momentum_buffer"]
        buffer.lerp_(gradient, 1 - momentum)
        return gradient.lerp(buffer, momentum)


def orthogonal(matrices: Tensor) -> Tensor:
    """Of each of these matrices (M, ., .) one near to U V^T of its U S V^T: all singular values are about one.

    Five Newton-Schulz rounds of the quintic that Muon was published with; they end between 0.7 and 1.2.
    """
    is_tall = matrices.shape[-2] > matrices.shape[-1]
    x_MRK = matrices.mT if is_tall else matrices
    x_MRK = x_MRK.float() if matrices.device.type == "cpu" else x_MRK.bfloat16()
    x_MRK = x_MRK / x_MRK.norm(dim=(-2, -1), keepdim=True).clamp(min=_EPS)  # so no singular value is above 1
    a, b, c = _QUINTIC
    for _ in range(_ROUNDS):
        gram_MRR = x_MRK @ x_MRK.mT
        update_MRR = torch.baddbmm(gram_MRR, gram_MRR, gram_MRR, beta=b, alpha=c)
        x_MRK = torch.baddbmm(x_MRK, update_MRR, x_MRK, beta=a)
    return x_MRK.mT if is_tall else x_MRK
