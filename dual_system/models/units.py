"""The modules to shard with FSDP2: they hold most weights of both systems and are called through ``forward`` alone.

FSDP2 gathers a module's weights in hooks around ``forward``. In pi0.5's layers, GR00T's blocks and PONDER's vision
blocks only the MLPs qualify, which hold most of the weights: attention is called through other methods
(`gemma.Attention.qkv`, `ponder.vision`).
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
    """Returns the shardable modules in the order of the model; none contains another."""
    return [module for module in model.modules() if isinstance(module, _UNITS)]
