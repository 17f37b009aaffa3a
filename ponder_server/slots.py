"""The memory of several contexts: one slot each, allocated once, when the engine starts.

A slot holds, for every attention layer, the keys and values of its tokens, and for every Gated DeltaNet layer one
state that summarises all tokens. Keys and values are append-only, so restoring them only needs the length; the states
are overwritten by every append, so restoring them needs a copy. (transformers' own caches have one length for all rows
and cannot be restored.) The sessions keep the slots' lengths.

# N slots, G key heads, S most tokens of a slot, D head dimension, C conv channels, W conv width
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class SlotSize:
    """Memory of one context of a given network."""

    bytes_per_token: int
    """Keys and values, all attention layers together."""
    state_bytes: int
    """Recurrent and convolution states, all other layers together; independent of the length."""

    def slot_bytes(self, max_tokens: int) -> int:
        return self.bytes_per_token * max_tokens + self.state_bytes


def slot_size(text_config: Any, dtype: torch.dtype) -> SlotSize:
    """Computes the size from the configuration alone, without allocating."""
    num_attention = sum(kind == "full_attention" for kind in text_config.layer_types)
    num_recurrent = len(text_config.layer_types) - num_attention
    token_elements = 2 * text_config.num_key_value_heads * text_config.head_dim
    conv_elements = _conv_channels(text_config) * text_config.linear_conv_kernel_dim
    recurrent_elements = (
        text_config.linear_num_value_heads * text_config.linear_key_head_dim * text_config.linear_value_head_dim
    )
    return SlotSize(
        bytes_per_token=num_attention * token_elements * dtype.itemsize,
        state_bytes=num_recurrent * (conv_elements * dtype.itemsize + recurrent_elements * torch.float32.itemsize),
    )


@dataclass(frozen=True, slots=True, eq=False)
class AttentionMemory:
    """Keys and values of one attention layer; positions beyond a slot's length hold garbage."""

    keys: Tensor
    """(N, G, S, D)"""
    values: Tensor
    """(N, G, S, D)"""


@dataclass(frozen=True, slots=True, eq=False)
class RecurrentMemory:
    """States of one Gated DeltaNet layer. An empty context's are zero, so the first append is no special case."""

    conv: Tensor
    """(N, C, W): the last W inputs of the convolution."""
    state: Tensor
    """(N, value heads, key dim, value dim) float32 whatever the model's dtype: it sums over thousands of tokens."""
    kept_conv: Tensor
    """A second state, as an append's first tokens leave it (`Keep`)."""
    kept_state: Tensor


class Keep(NamedTuple):
    """Where rows leave a second state, and after how many of their tokens."""

    memory: Tensor
    """(N, ...), like the state itself."""
    num_B: Tensor
    """int64; 0: this row leaves none."""

    def put(self, slot_B: Tensor, state: Tensor | None) -> None:
        """Writes ``state`` (B, ...) to the slots of the rows that leave one."""
        assert state is not None, "it was asked for"
        is_kept = (self.num_B > 0).view(-1, *[1] * (state.dim() - 1))
        self.memory[slot_B] = torch.where(is_kept, state, self.memory[slot_B])


class SlotMemory:
    """N slots of at most ``max_tokens`` tokens each."""

    def __init__(
        self, text_config: Any, *, num_slots: int, max_tokens: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        self.num_slots = num_slots
        self.max_tokens = max_tokens
        self.attention: dict[int, AttentionMemory] = {}
        self.recurrent: dict[int, RecurrentMemory] = {}
        kv_shape = (num_slots, text_config.num_key_value_heads, max_tokens, text_config.head_dim)
        conv_shape = (_conv_channels(text_config), text_config.linear_conv_kernel_dim)
        state_shape = (
            text_config.linear_num_value_heads,
            text_config.linear_key_head_dim,
            text_config.linear_value_head_dim,
        )
        # A slot's states lie side by side: to save or restore them takes two copies, however many layers there are.
        num_recurrent = sum(kind != "full_attention" for kind in text_config.layer_types)
        self._conv = torch.zeros(num_slots, num_recurrent, *conv_shape, device=device, dtype=dtype)
        self._state = torch.zeros(num_slots, num_recurrent, *state_shape, device=device)
        self._kept_conv, self._kept_state = torch.zeros_like(self._conv), torch.zeros_like(self._state)
        for index, kind in enumerate(text_config.layer_types):
            if kind == "full_attention":
                keys, values = (torch.empty(kv_shape, device=device, dtype=dtype) for _ in range(2))
                self.attention[index] = AttentionMemory(keys, values)
            else:
                own = len(self.recurrent)
                states = (self._conv, self._state, self._kept_conv, self._kept_state)
                self.recurrent[index] = RecurrentMemory(*(state[:, own] for state in states))

    def states(self, slot: int) -> list[Tensor]:
        """Views of all that an append overwrites in a slot: (layers, C, W) and (layers, V, key dim, value dim)."""
        return [self._conv[slot], self._state[slot]]

    def kept_states(self, slot: int) -> list[Tensor]:
        """Views of a slot's second state, as `states`."""
        return [self._kept_conv[slot], self._kept_state[slot]]

    def keys_and_values(self, slot: int, num_tokens: int) -> list[Tensor]:
        """Views (G, num_tokens, D) of a slot's keys and values, which an append only extends."""
        return [
            tensor[slot, :, :num_tokens] for layer in self.attention.values() for tensor in (layer.keys, layer.values)
        ]

    def clear(self, slot: int) -> None:
        """Resets a slot to the empty context."""
        for tensor in self.states(slot):
            tensor.zero_()


def _conv_channels(text_config: Any) -> int:
    key_size = text_config.linear_num_key_heads * text_config.linear_key_head_dim
    value_size = text_config.linear_num_value_heads * text_config.linear_value_head_dim
    return int(2 * key_size + value_size)
