"""The functions of transformers' Qwen3.5 that a forward pass needs besides its modules, under typed names.

Both delta rules compute Gated DeltaNet's recurrence, one over many tokens and one over a single token. transformers
takes fla's kernels for them where that package is installed, and plain torch elsewhere.

# B rows, T tokens, K key heads, V value heads, D head dimensions
"""

import logging
from collections.abc import Callable
from typing import TypeAlias

import torch
from torch import Tensor
from transformers.models.qwen3_5.modeling_qwen3_5 import (
    apply_rotary_pos_emb,
    torch_chunk_gated_delta_rule,
    torch_recurrent_gated_delta_rule,
)

if not torch.cuda.is_available():  # transformers recommends fla at every start, which a CPU cannot run
    logging.getLogger("transformers.integrations.hub_kernels").setLevel(logging.ERROR)

DeltaRule: TypeAlias = Callable[..., tuple[Tensor, Tensor]]
"""(queries (B, T, K, D), keys, values (B, T, V, D), g=log decay (B, T, V), beta=(B, T, V), initial_state=(B, V, D, D))
-> (outputs (B, T, V, D), next state)."""

delta_rule_of_many: DeltaRule = torch_chunk_gated_delta_rule
delta_rule_of_one: DeltaRule = torch_recurrent_gated_delta_rule
rotate: Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]] = apply_rotary_pos_emb
"""(queries (B, heads, T, D), keys, cos, sin (B, T, rotary dim)) -> queries and keys with rotary positions."""
