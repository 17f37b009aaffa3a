"""Qwen3.5's multi-token prediction: one more attention layer, which guesses the token after the one that is known.

A projection makes one input of a token and the network's hidden state before it, the layer looks back over such inputs,
and the network's own LM head reads from its output which token follows. Fed with its own output it goes on guessing.
Source: the tensors of public Qwen3.5 checkpoints (``mtp.*``), and how vLLM puts them together; transformers leaves them
out.
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
    """A checkpoint's block as modules; beyond ``merge`` it is a text stack of one layer, as Qwen3.5's is of many."""

    def __init__(self, ponder: Ponder) -> None:
        """Copies ``ponder.mtp`` to the device and into the dtype of ``ponder``.

        Raises ValueError if it is not one block of one layer: what a second one would be fed with, no public
        checkpoint tells.
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
        """What the layer reads (T, H): of each token its embedding, and the last hidden state before it."""
        both = (self.pre_fc_norm_embedding(embeds_TH), self.pre_fc_norm_hidden(hidden_TH))
        merged_TH: Tensor = self.fc(torch.cat(both, dim=-1))
        return merged_TH
