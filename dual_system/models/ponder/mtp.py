"""Qwen3.5's multi-token prediction: an extra attention layer that predicts the token after a known one.

A projection merges a token's embedding with the network's hidden state before it, the layer attends causally over
these inputs, and the network's own LM head predicts the next token from its output. Fed with its own output it
predicts further tokens. Source: the tensors of public Qwen3.5 checkpoints (``mtp.*``), and vLLM's implementation;
transformers omits it.
"""

# T tokens, H hidden

from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn
from transformers.models.qwen3_5.modeling_qwen3_5 import Qwen3_5DecoderLayer, Qwen3_5RMSNorm

from dual_system.models.ponder.checkpoint import MTP_PREFIX
from dual_system.models.ponder.network import Ponder


class MtpHead(nn.Module):
    """A checkpoint's MTP block as modules; after ``merge`` it is a text stack like Qwen3.5's, with one layer."""

    def __init__(self, ponder: Ponder) -> None:
        """Copies ``ponder.mtp`` to the device and dtype of ``ponder``.

        Raises ValueError unless the block has exactly one layer: no public checkpoint shows a second one's inputs.
        """
        super().__init__()
        num_layers = len({name.split(".")[2] for name in ponder.mtp if name.startswith(f"{MTP_PREFIX}layers.")})
        if num_layers != 1:
            raise ValueError(f"the checkpoint has {num_layers} layers of multi-token prediction; 1 can be run.")
        self.text_config: Any = deepcopy(ponder.qwen.config.text_config)
        self.text_config.layer_types = ["full_attention"]
        hidden_size, epsilon = self.text_config.hidden_size, self.text_config.rms_norm_eps
        with torch.device("meta"):
            self.pre_fc_norm_embedding: Any = Qwen3_5RMSNorm(hidden_size, eps=epsilon)
            self.pre_fc_norm_hidden: Any = Qwen3_5RMSNorm(hidden_size, eps=epsilon)
            self.fc = nn.Linear(2 * hidden_size, hidden_size, bias=False)
            self.layers = nn.ModuleList([Qwen3_5DecoderLayer(self.text_config, 0)])
            self.norm: Any = Qwen3_5RMSNorm(hidden_size, eps=epsilon)
        own = {name.removeprefix(MTP_PREFIX): tensor for name, tensor in ponder.mtp.items()}
        own = {name: tensor.to(ponder.device, ponder.dtype, copy=True) for name, tensor in own.items()}
        self.load_state_dict(own, assign=True)
        self.requires_grad_(False)
        self.rotary_emb: Any = ponder.qwen.model.language_model.rotary_emb

    def merge(self, embeds_TH: Tensor, hidden_TH: Tensor) -> Tensor:
        """Input of the layer (T, H), from each token's embedding and the last hidden state before it."""
        both = (self.pre_fc_norm_embedding(embeds_TH), self.pre_fc_norm_hidden(hidden_TH))
        merged_TH: Tensor = self.fc(torch.cat(both, dim=-1))
        return merged_TH
