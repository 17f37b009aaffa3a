"""One episode's context on the device: append, save, restore, fork.

Append-only with one exception: the state saved before an append can be restored. That costs little, because
only the recurrent layers forget what they were: their state is copied out and back, while keys and values
past the restored length are simply no longer looked at. (transformers' own caches cannot do this: ``crop``
refuses recurrent layers.)

All memory is allocated once, at construction; saving, restoring and clearing write in place, so addresses
stay what they were and a captured CUDA graph may hold on to them.

# T new tokens, S tokens in the cache after the append, H hidden, D conv channels, W conv width
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

from ponder_server.contract import ContextFull
from ponderpounce.models.ponder import Ponder


class _AttentionLayer:
    """Keys and values of one attention layer, (1, heads, max tokens, head_dim) each."""

    def __init__(self, config: Any, max_tokens: int, device: torch.device, dtype: torch.dtype) -> None:
        shape = (1, config.num_key_value_heads, max_tokens, config.head_dim)
        self.keys = torch.zeros(shape, device=device, dtype=dtype)
        self.values = torch.zeros(shape, device=device, dtype=dtype)


class _RecurrentLayer:
    """State of one Gated DeltaNet layer. Zeros are the state of an empty context.

    The attribute names are transformers'; 5.17 reads them directly.
    """

    record_past = False

    def __init__(self, config: Any, device: torch.device, dtype: torch.dtype) -> None:
        key_size = config.linear_num_key_heads * config.linear_key_head_dim
        value_size = config.linear_num_value_heads * config.linear_value_head_dim
        conv_shape = (1, 2 * key_size + value_size, config.linear_conv_kernel_dim)
        self.conv_states = [torch.zeros(conv_shape, device=device, dtype=dtype)]
        recurrent_shape = (
            1,
            config.linear_num_value_heads,
            config.linear_key_head_dim,
            config.linear_value_head_dim,
        )
        # float32 in every dtype of model: the state sums up thousands of tokens
        self.recurrent_states = [torch.zeros(recurrent_shape, device=device, dtype=torch.float32)]


class SessionCache:
    """The ``LayerCache`` of one session. ``num_tokens`` is set by the session, before each forward."""

    def __init__(self, text_config: Any, max_tokens: int, device: torch.device, dtype: torch.dtype) -> None:
        self.num_tokens = 0
        self.attention: dict[int, _AttentionLayer] = {}
        self.recurrent: dict[int, _RecurrentLayer] = {}
        for index, layer_type in enumerate(text_config.layer_types):
            if layer_type == "full_attention":
                self.attention[index] = _AttentionLayer(text_config, max_tokens, device, dtype)
            else:
                self.recurrent[index] = _RecurrentLayer(text_config, device, dtype)
        self.layers: list[_AttentionLayer | _RecurrentLayer] = [
            (self.attention | self.recurrent)[index] for index in range(len(text_config.layer_types))
        ]

    def update(self, keys: Tensor, values: Tensor, layer_idx: int) -> tuple[Tensor, Tensor]:
        layer = self.attention[layer_idx]
        first, end = self.num_tokens, self.num_tokens + keys.shape[2]
        layer.keys[:, :, first:end] = keys
        layer.values[:, :, first:end] = values
        return layer.keys[:, :, :end], layer.values[:, :, :end]

    def update_conv_state(self, inputs: Tensor, layer_idx: int, conv_kernel_size: int) -> Tensor:
        """Keeps the last W of the inputs (1, D, T); returns them with the W before them."""
        state = self.recurrent[layer_idx].conv_states[0]
        extended = torch.cat([state, inputs], dim=-1)
        state.copy_(extended[..., -conv_kernel_size:])
        return extended

    def update_recurrent_state(self, state: Tensor, layer_idx: int) -> Tensor:
        return self.recurrent[layer_idx].recurrent_states[0].copy_(state)

    def get_conv_state(self, layer_idx: int, state_idx: int = 0) -> Tensor:
        return self.recurrent[layer_idx].conv_states[state_idx]

    def get_recurrent_state(self, layer_idx: int, state_idx: int = 0) -> Tensor:
        return self.recurrent[layer_idx].recurrent_states[state_idx]

    def has_previous_state(self, layer_idx: int, state_idx: int = 0) -> bool:
        """True even when empty: zeros are a valid past, so there is no special first append."""
        return True

    def is_recording_past(self, layer_idx: int) -> bool:
        return False

    def recurrent_tensors(self) -> list[Tensor]:
        """Every tensor that an append overwrites and that must be copied to be kept."""
        return [t for layer in self.recurrent.values() for t in (*layer.conv_states, *layer.recurrent_states)]


@dataclass(slots=True, kw_only=True)
class SavedState:
    """A point in a session to come back to: lengths, and copies of the recurrent tensors."""

    num_tokens: int
    next_position: int
    tensors: list[Tensor]


class Session:
    """A context of at most ``max_tokens`` tokens. Calls must run under ``torch.inference_mode``."""

    def __init__(self, ponder: Ponder, *, max_tokens: int) -> None:
        self._ponder = ponder
        self._cache = SessionCache(ponder.qwen.config.text_config, max_tokens, ponder.device, ponder.dtype)
        self._next_position = 0
        self.name = ""
        self.max_tokens = max_tokens
        self.ids: list[int] = []
        """Every token of the context, as the training row of this episode would have it."""

    @property
    def num_tokens(self) -> int:
        return len(self.ids)

    @property
    def room(self) -> int:
        return self.max_tokens - len(self.ids)

    def clear(self) -> None:
        """Empties the context for the next episode."""
        self.ids.clear()
        self._next_position = 0
        for tensor in self._cache.recurrent_tensors():
            tensor.zero_()

    def append(self, ids_T: Sequence[int], embeds_TH: Tensor) -> Tensor:
        """Appends tokens; their final hidden states (T, H). Raises ContextFull before anything changes."""
        num_tokens, num_new = self.num_tokens, len(ids_T)
        if num_new > self.room:
            raise ContextFull(session=self.name, used=num_tokens, wanted=num_new, limit=self.max_tokens)
        positions_4T, next_position = self._ponder.format.positions(
            ids_T, first_index=num_tokens, first_position=self._next_position
        )
        positions_4BT = torch.from_numpy(positions_4T)[:, None].to(embeds_TH.device)
        visible_BTS = None
        if num_new > 1:
            visible = torch.ones(1, num_new, num_tokens + num_new, dtype=torch.bool, device=embeds_TH.device)
            visible_BTS = visible.tril_(diagonal=num_tokens)
        self._cache.num_tokens = num_tokens
        hidden_BTH: Tensor = self._ponder(embeds_TH[None], positions_4BT, cache=self._cache, visible_BTS=visible_BTS)
        self.ids.extend(ids_T)
        self._next_position = next_position
        return hidden_BTH[0]

    def save(self, into: SavedState | None = None) -> SavedState:
        """Copies the state out, into ``into`` if given (no allocation)."""
        tensors = self._cache.recurrent_tensors()
        if into is None:
            into = SavedState(num_tokens=0, next_position=0, tensors=[torch.empty_like(t) for t in tensors])
        for kept, tensor in zip(into.tensors, tensors, strict=True):
            kept.copy_(tensor)
        into.num_tokens, into.next_position = self.num_tokens, self._next_position
        return into

    def restore(self, saved: SavedState) -> None:
        """Goes back to a state saved in the present episode; what was appended since never happened."""
        assert saved.num_tokens <= self.num_tokens, "a session can only go back"
        for tensor, kept in zip(self._cache.recurrent_tensors(), saved.tensors, strict=True):
            tensor.copy_(kept)
        del self.ids[saved.num_tokens :]
        self._next_position = saved.next_position

    def fork_into(self, other: Self) -> None:
        """Makes ``other`` an independent copy of this context. Raises ContextFull if it is too small."""
        if self.num_tokens > other.max_tokens:
            raise ContextFull(session=other.name, used=0, wanted=self.num_tokens, limit=other.max_tokens)
        for index, layer in self._cache.attention.items():
            copy = other._cache.attention[index]
            copy.keys[:, :, : self.num_tokens] = layer.keys[:, :, : self.num_tokens]
            copy.values[:, :, : self.num_tokens] = layer.values[:, :, : self.num_tokens]
        for theirs, ours in zip(other._cache.recurrent_tensors(), self._cache.recurrent_tensors(), strict=True):
            theirs.copy_(ours)
        other.ids[:] = self.ids
        other._next_position = self._next_position
