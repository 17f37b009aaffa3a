"""Qwen3.5's Gated DeltaNet layer over whole rows, for training: transformers' parameters, our rule.

# B rows, T tokens, H hidden, C conv channels
"""

import logging
from typing import Any

from torch import Tensor
from torch.nn import functional as F
from transformers.models.qwen3_5.modeling_qwen3_5 import Qwen3_5GatedDeltaNet

from dual_system.models.ponder import mixers
from dual_system.models.ponder.delta_rule import gated_delta_rule

# transformers recommends fla's kernels at every start; none is called.
logging.getLogger("transformers.integrations.hub_kernels").setLevel(logging.ERROR)


class GatedDelta(Qwen3_5GatedDeltaNet):  # type: ignore[misc]  # transformers is untyped here
    """transformers' layer with its parameter names. None of its own kernels is called, so the packages fla and
    causal_conv1d change nothing if they are installed."""

    def forward(
        self, hidden_states: Tensor, cache_params: Any = None, attention_mask: Tensor | None = None, **_: Any
    ) -> Tensor:
        """(B, T, H) to (B, T, H), causal; rows may be padded on the right.

        Raises ValueError for a cache or a mask, which serving keeps itself (``ponder_server/decoder.py``).
        """
        if cache_params is not None or attention_mask is not None:
            raise ValueError(
                "a PONDER's Gated DeltaNet reads whole rows: expected no cache_params and no attention_mask; for "
                "transformers' own generation, load its checkpoint with Qwen3_5ForConditionalGeneration"
            )
        inputs_BTC, decay, beta, gate = mixers.delta_inputs(self, hidden_states)
        conv, length = self.conv1d, inputs_BTC.shape[1]
        inputs_BCT = inputs_BTC.transpose(1, 2).to(conv.weight.dtype)
        mixed_BCT = F.conv1d(inputs_BCT, conv.weight, conv.bias, padding=conv.padding, groups=conv.groups)
        mixed_BCT = F.silu(mixed_BCT[..., :length]).to(inputs_BTC.dtype)
        read, _state = gated_delta_rule(*mixers.heads(self, mixed_BCT.transpose(1, 2)), g=decay, beta=beta)
        mixed_BTH: Tensor = self.out_proj(mixers.normed(self, read, gate))
        return mixed_BTH
