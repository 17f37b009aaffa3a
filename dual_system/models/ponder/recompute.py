"""Activation checkpointing for PONDER: a layer keeps what came in, and is run again on the way back.

An episode of some minutes is tens of thousands of tokens, and what 32 layers leave of each for the way back is most
of a GPU's memory. Recomputed, a layer leaves its input alone; a step takes its forward once more, and its numbers are
the same. POUNCE's invocations are short, and are not recomputed: `pp-train --max-invocations` bounds them.
"""

from __future__ import annotations

from functools import partial

from torch.utils.checkpoint import checkpoint
from transformers.modeling_layers import GradientCheckpointingLayer

from dual_system.models.ponder.network import Ponder


def recompute_layers(ponder: Ponder) -> None:
    """From now on the language model's layers do so whenever gradients are wanted.

    Raises:
        TypeError: transformers' layers cannot any more.
        ValueError: it has a reader of demonstrations or specialists, which run layers by their parts.
    """
    if ponder.reader is not None or ponder.specialists:
        raise ValueError(
            "a PONDER with a reader of demonstrations or specialists cannot be recomputed: leave --recompute out"
        )
    for layer in ponder.qwen.model.language_model.layers:
        if not isinstance(layer, GradientCheckpointingLayer):
            raise TypeError(f"expected a GradientCheckpointingLayer of transformers, came {type(layer).__name__}")
        layer._gradient_checkpointing_func = partial(checkpoint, use_reentrant=False)
        layer.gradient_checkpointing = True
        # transformers asks for it. Of the layer alone: what is inside stays as in serving, without dropout.
        layer.training = True
