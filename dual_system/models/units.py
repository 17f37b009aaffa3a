"""The parts of both systems that hold most weights and run through ``forward`` alone.

What gathers weights when a module runs (FSDP2) sees only ``forward``. Of pi0.5's layers, GR00T's blocks and PONDER's
vision blocks it can have the MLPs, most of their weights: their attention is called otherwise (`gemma.Attention.qkv`,
`ponder_vision`).
"""

from __future__ import annotations

from torch import nn
from transformers.models.qwen3_5.modeling_qwen3_5 import Qwen3_5DecoderLayer, Qwen3_5VisionMLP

from dual_system.models.groot.blocks import BlockMlp
from dual_system.models.groot.qwen3 import Qwen3Layer
from dual_system.models.pi05.gemma import GeGlu
from dual_system.models.siglip import VisionLayer

_UNITS = (Qwen3_5DecoderLayer, Qwen3_5VisionMLP, VisionLayer, GeGlu, Qwen3Layer, BlockMlp)


def units_of(model: nn.Module) -> list[nn.Module]:
    """Returns them in the order of the model; none holds another."""
    return [module for module in model.modules() if isinstance(module, _UNITS)]
