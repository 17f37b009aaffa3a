"""Activation checkpointing for PONDER: a layer stores only its input and is run again in the backward pass.

An episode of some minutes is tens of thousands of tokens, and the activations of 32 layers take most of a GPU's
memory. Checkpointing costs a second forward pass per step; the gradients are the same. POUNCE's invocations are short
and are not recomputed: `pp-train --max-invocations` bounds them.
"""

from __future__ import annotations

from functools import partial

from torch.utils.checkpoint import checkpoint
from transformers.modeling_layers import GradientCheckpointingLayer

from dual_system.models.ponder.network import Ponder


def recompute_layers(ponder: Ponder) -> None:
    """Turns on activation checkpointing for the language model's layers, in place.

    Raises:
        TypeError: transformers' layers no longer support it.
    """
    for layer in ponder.qwen.model.language_model.layers:
        if not isinstance(layer, GradientCheckpointingLayer):
            raise TypeError(f"expected a GradientCheckpointingLayer of transformers, came {type(layer).__name__}")
        layer._gradient_checkpointing_func = partial(checkpoint, use_reentrant=False)
        layer.gradient_checkpointing = True
        # transformers checkpoints only in training mode. Its submodules stay in eval mode, without dropout.
        layer.training = True
