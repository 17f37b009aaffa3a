"""Which of PONDER's matrices are int8: those of the text layers and of the vision tower.

Embeddings, LM head, norms and convolutions stay as they are, and so do the two small projections that set the decay and
the writing strength of the recurrent layers, whose errors would add up over thousands of tokens.
"""

from ponderpounce.models.int8 import quantise_where
from ponderpounce.models.ponder import Ponder

_NARROW = ("model.language_model.layers.", "model.visual.blocks.", "model.visual.merger.")
_KEPT = ("linear_attn.in_proj_a.weight", "linear_attn.in_proj_b.weight")


def quantise(ponder: Ponder) -> int:
    """Replaces the layers in place; returns how many bytes that saved."""
    return quantise_where(ponder.qwen, lambda name: name.startswith(_NARROW) and not name.endswith(_KEPT))
