"""Which of PONDER's matrices are narrow, in int8 or fp8: those of the text layers and of the vision tower.

Embeddings, LM head, norms and convolutions stay as they are, and so do the two small projections that set the decay and
the writing strength of the recurrent layers, whose errors would add up over thousands of tokens.
"""

from typing import Final

import torch

from dual_system.models.fp8 import Fp8Linear, missing_for
from dual_system.models.int8 import Int8Linear
from dual_system.models.narrow_linear import quantise_where
from dual_system.models.ponder.network import Ponder
from ponder_server.contract import WeightsName

_NARROW = ("model.language_model.layers.", "model.visual.blocks.", "model.visual.merger.")
_KEPT = ("linear_attn.in_proj_a.weight", "linear_attn.in_proj_b.weight")
_LAYERS: Final = {"int8": Int8Linear, "fp8": Fp8Linear}


def check_weights(weights: WeightsName, device: torch.device) -> None:
    """Raises ValueError if ``device`` cannot have such weights; the message says what can be had instead."""
    if weights == "int8" and device.type != "cpu":
        raise ValueError("int8 weights are for a CPU; take --weights fp8, or leave it out and take --dtype bfloat16.")
    if weights == "fp8" and (missing := missing_for(device)):
        raise ValueError(f"{missing}; take --weights int8 on a CPU, or leave it out and take --dtype bfloat16.")


def quantise(ponder: Ponder, weights: WeightsName) -> int:
    """Replaces the layers in place; returns how many bytes that saved, 0 for float weights."""
    if weights == "float":
        return 0
    kind = _LAYERS[weights]
    saved = quantise_where(ponder.qwen, lambda name: name.startswith(_NARROW) and not name.endswith(_KEPT), kind)
    for reader in (ponder.reader, *ponder.specialists.values()):
        if reader is not None:
            saved += quantise_where(reader, lambda name: not name.endswith(_KEPT), kind)
    return saved
