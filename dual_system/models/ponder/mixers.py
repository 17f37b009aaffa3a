"""The per-token parts of Qwen3.5's attention and Gated DeltaNet: input projections, norms, gates, output projection.

They call a layer's own modules in the order of transformers' forward. The mixing of tokens differs and is elsewhere:
training mixes whole rows (`gated_delta`), serving a few tokens against a cache (``ponder_server/decoder.py``).

# ... any token axes, H hidden, h heads, g key heads, D head dimension, C conv channels, V value heads of size E
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from torch import Tensor
from torch.nn import functional as F
from transformers.models.qwen3_5.modeling_qwen3_5 import apply_rotary_pos_emb

rotate: Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]] = apply_rotary_pos_emb
"""(queries (B, heads, T, D), keys, cos, sin (B, T, rotary dim)) -> queries and keys with rotary positions."""


class AttentionInputs(NamedTuple):
    """Projections of one attention layer, before RoPE."""

    queries: Tensor
    """(..., h, D), after q_norm."""
    keys: Tensor
    """(..., g, D), after k_norm."""
    values: Tensor
    """(..., g, D)."""
    gate: Tensor
    """(..., h, D), before its sigmoid."""


def attention_inputs(attention: Any, hidden: Tensor) -> AttentionInputs:
    """Projects hidden states (..., H)."""
    size = attention.head_dim
    queries, gate = attention.q_proj(hidden).unflatten(-1, (-1, 2 * size)).chunk(2, dim=-1)
    keys = attention.k_norm(attention.k_proj(hidden).unflatten(-1, (-1, size)))
    values = attention.v_proj(hidden).unflatten(-1, (-1, size))
    return AttentionInputs(attention.q_norm(queries), keys, values, gate)


def attended(attention: Any, seen: Tensor, gate: Tensor) -> Tensor:
    """Gates the attention's output ``seen`` (..., h, D) and projects it to (..., H)."""
    mixed: Tensor = attention.o_proj((seen * gate.sigmoid()).flatten(-2))
    return mixed


class DeltaInputs(NamedTuple):
    """Projections of one Gated DeltaNet layer, before the convolution."""

    inputs: Tensor
    """(..., C): queries, keys and values, the convolution's input."""
    decay: Tensor
    """(..., V): log decay, float32."""
    beta: Tensor
    """(..., V)."""
    gate: Tensor
    """(..., V E), gate of the output norm."""


def delta_inputs(delta: Any, hidden: Tensor, num_rows: int | None = None) -> DeltaInputs:
    """Projects hidden states (..., H) and keeps the first ``num_rows``. Padding rows are multiplied too, because the
    last bits of a matrix product and of a softplus depend on the number of rows."""
    projections = (delta.in_proj_qkv, delta.in_proj_a, delta.in_proj_b, delta.in_proj_z)
    inputs, speed, beta, gate = (projection(hidden)[:num_rows] for projection in projections)
    decay = -delta.A_log.float().exp() * F.softplus(speed.float() + delta.dt_bias)
    return DeltaInputs(inputs, decay, beta.sigmoid(), gate)


def heads(delta: Any, mixed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Splits the convolution's output (..., C) into queries, keys (..., heads, D) and values (..., V, E)."""
    queries, keys, values = mixed.split([delta.key_dim, delta.key_dim, delta.value_dim], dim=-1)
    size = delta.head_k_dim
    return (
        queries.unflatten(-1, (-1, size)),
        keys.unflatten(-1, (-1, size)),
        values.unflatten(-1, (-1, delta.head_v_dim)),
    )


def normed(delta: Any, read: Tensor, gate: Tensor) -> Tensor:
    """Applies the gated output norm: ``read`` (..., V, E) -> (..., V E), the input of the output projection."""
    size = delta.head_v_dim
    return delta.norm(read.reshape(-1, size), gate.reshape(-1, size)).reshape(gate.shape)  # type: ignore[no-any-return]
