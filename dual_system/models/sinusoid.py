"""A scalar as sines and cosines: how flow time and cognition age enter a network."""

# B batch, F features

import math

import torch
from torch import Tensor


def sinusoid(values_B: Tensor, num_features: int, *, min_period: float, max_period: float) -> Tensor:
    """Returns ``[sin | cos]`` of ``values_B`` at log-spaced periods, shape (B, num_features), float32.

    Periods run from ``min_period`` to ``max_period`` in the unit of the values. Angles are float64, as in the
    public pi0.5 code: at time 1 and period 4e-3 the angle is 1571 rad, which float32 resolves to 1e-4 only.
    """
    if num_features % 2:
        raise ValueError(f"sinusoid needs an even number of features, came {num_features}")
    fraction = torch.linspace(0.0, 1.0, num_features // 2, dtype=torch.float64, device=values_B.device)
    period = min_period * (max_period / min_period) ** fraction
    angle_BF = values_B.to(torch.float64)[:, None] * (2.0 * math.pi / period)
    return torch.cat([angle_BF.sin(), angle_BF.cos()], dim=-1).to(torch.float32)
