"""Narrow weights for the matrices of PONDER's text layers, int8 also for its vision tower's.

fp8 leaves the tower alone: it is small, and to quantise the rows of its 110 products, ten more launches each, takes
longer than fp8 spares.

Embeddings, LM head, norms and convolutions keep their precision, and so do the two small projections for the decay and
the write strength of the recurrent layers, whose errors would accumulate over thousands of tokens.
"""

from functools import partial
from typing import Final

import torch

from dual_system.models.fp8 import Fp8Linear, missing_for
from dual_system.models.int8 import Int8Linear
from dual_system.models.narrow_linear import quantise_where
from dual_system.models.ponder.network import Ponder
from ponder_server.contract import WeightsName

_TEXT = ("model.language_model.layers.",)
_NARROW: Final = {"int8": (*_TEXT, "model.visual.blocks.", "model.visual.merger."), "fp8": _TEXT}
_KEPT = ("linear_attn.in_proj_a.weight", "linear_attn.in_proj_b.weight")
_LAYERS: Final = {"int8": Int8Linear, "fp8": Fp8Linear}
MOST_CHANGE = 0.2
"""Largest relative L2 change of cognition that trained weights may take: seven times what fp8 does to the trained pair
of this repository."""


def check_weights(weights: WeightsName, device: torch.device) -> None:
    """Raises ValueError if ``device`` does not support these weights; the message names an alternative."""
    if weights == "int8" and device.type != "cpu":
        raise ValueError("int8 weights are for a CPU; take --weights fp8, or leave it out and take --dtype bfloat16.")
    if weights == "fp8" and (missing := missing_for(device)):
        raise ValueError(f"{missing}; take --weights int8 on a CPU, or leave it out and take --dtype bfloat16.")


def check_change(weights: WeightsName, change: float, *, is_random: bool) -> None:
    """Raises ValueError if narrow weights change cognition too much; random ones, which say nothing, may."""
    if not is_random and not change <= MOST_CHANGE:  # also refuses NaN
        raise ValueError(
            f"{weights} weights change cognition by {change:.1e} (relative L2), at most {MOST_CHANGE:.0e} is allowed: "
            "this network does not bear them. Leave --weights out, and take --dtype bfloat16."
        )


def is_narrow(weights: WeightsName, name: str) -> bool:
    """Whether the matrix of this parameter's name takes a byte per weight."""
    return weights != "float" and name.startswith(_NARROW[weights]) and not name.endswith(_KEPT)


def quantise(ponder: Ponder, weights: WeightsName) -> int:
    """Replaces the layers in place; returns the number of bytes saved, 0 for float weights."""
    if weights == "float":
        return 0
    return quantise_where(ponder.qwen, partial(is_narrow, weights), _LAYERS[weights])
