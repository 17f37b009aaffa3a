"""Matrices of a network that are multiplied with the same rows, packed into one."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn


class Matrix(NamedTuple):
    """Stacked linear layers: weight (out, in) as in PyTorch, and bias (out,) if they have one."""

    weight: Tensor
    bias: Tensor | None

    @classmethod
    def of(cls, *layers: nn.Linear) -> Matrix:
        """Packs ``layers``, whose parameters become views, so that no weight is stored twice."""
        bias = None if layers[0].bias is None else _stacked([layer.bias for layer in layers])
        return cls(_stacked([layer.weight for layer in layers]), bias)


def _stacked(parameters: list[Tensor]) -> Tensor:
    if len(parameters) == 1:
        return parameters[0].data
    stacked = torch.cat([parameter.data for parameter in parameters])
    for parameter, part in zip(parameters, stacked.split([len(one) for one in parameters]), strict=True):
        parameter.data = part
    return stacked
