"""What Qwen3.5's attention and Gated DeltaNet do with one token by itself, before and after tokens are mixed.

A layer's own modules, in the order of transformers' forward; who mixes the tokens, and over what memory, differs:
training reads whole rows (`gated_delta`), rows of two kinds of tokens (`reader`), serving a few tokens behind a cache
(``ponder_server/decoder.py``). All of them come here for the rest.

# ... any axes of tokens, H hidden, h heads, g heads of keys, D head dimension, C conv channels
# V value heads, E their size
"""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor
from torch.nn import functional as F


class Asked(NamedTuple):
    """Of attention, before positions are told."""

    queries: Tensor
    """(..., h, D), normed."""
    keys: Tensor
    """(..., g, D), normed."""
    values: Tensor
    """(..., g, D)."""
    gate: Tensor
    """(..., h, D), before its sigmoid."""


def ask(attention: Any, hidden: Tensor) -> Asked:
    """Of hidden states (..., H)."""
    size = attention.head_dim
    queries, gate = attention.q_proj(hidden).unflatten(-1, (-1, 2 * size)).chunk(2, dim=-1)
    keys = attention.k_norm(attention.k_proj(hidden).unflatten(-1, (-1, size)))
    values = attention.v_proj(hidden).unflatten(-1, (-1, size))
    return Asked(attention.q_norm(queries), keys, values, gate)


def attended(attention: Any, seen: Tensor, gate: Tensor) -> Tensor:
    """(..., H) of what was seen, (..., h, D)."""
    mixed: Tensor = attention.o_proj((seen * gate.sigmoid()).flatten(-2))
    return mixed


class Written(NamedTuple):
    """Of Gated DeltaNet, before the convolution."""

    inputs: Tensor
    """(..., C): queries, keys and values, to be convolved."""
    decay: Tensor
    """(..., V): its logarithm, float32."""
    beta: Tensor
    """(..., V)."""
    gate: Tensor
    """(..., V E), for the norm of what is read."""


def write(delta: Any, hidden: Tensor, num_rows: int | None = None) -> Written:
    """Of hidden states (..., H); of their first ``num_rows`` alone, all of which are multiplied (bits of a product, and
    of a softplus, depend on how many numbers there are)."""
    projections = (delta.in_proj_qkv, delta.in_proj_a, delta.in_proj_b, delta.in_proj_z)
    inputs, speed, beta, gate = (projection(hidden)[:num_rows] for projection in projections)
    decay = -delta.A_log.float().exp() * F.softplus(speed.float() + delta.dt_bias)
    return Written(inputs, decay, beta.sigmoid(), gate)


def heads(delta: Any, mixed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Queries, keys (..., heads, D) and values (..., V, E) of what was convolved, (..., C)."""
    queries, keys, values = mixed.split([delta.key_dim, delta.key_dim, delta.value_dim], dim=-1)
    size = delta.head_k_dim
    return (
        queries.unflatten(-1, (-1, size)),
        keys.unflatten(-1, (-1, size)),
        values.unflatten(-1, (-1, delta.head_v_dim)),
    )


def normed(delta: Any, read: Tensor, gate: Tensor) -> Tensor:
    """(..., V E) of what was read, (..., V, E): what the layer's last projection takes."""
    size = delta.head_v_dim
    return delta.norm(read.reshape(-1, size), gate.reshape(-1, size)).reshape(gate.shape)  # type: ignore[no-any-return]
