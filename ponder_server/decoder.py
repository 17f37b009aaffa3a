"""One forward of Qwen3.5's text stack over several contexts: the network's own modules with our cache.

transformers' decoder has one length for all rows, updates the recurrent state with padding and attends to all that a
cache returns. Here every row is a slot with its own length, right padding has no effect, and attention reads valid
positions only. The modules are transformers'; the tests compare this file with their own forward.

# B rows, T tokens of a row with its padding, H hidden, D head dimension, C conv channels, W conv width
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from dual_system.models.ponder import mixers
from dual_system.models.ponder.delta_rule import gated_delta_keeping
from ponder_server.attention import attend
from ponder_server.slots import AttentionMemory, Keep, RecurrentMemory, SlotMemory
from ponder_server.threads import ALONE, Threads

LEAST_TOKENS = 4
"""Smallest number of rows times tokens of a forward. A CPU uses other kernels, which round differently, for one to
three rows of a matrix; from four on, a token's bits do not depend on the others in its forward."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Slot and number of tokens of a row, and how many hidden states the caller wants."""

    slot: int
    num_past: int
    num_new: int
    """Valid tokens of the row; 0 is an idle row. The rest up to T is padding."""
    num_wanted: int
    """Number of new tokens, counted from the last, whose hidden states are wanted."""
    num_kept: int = 0
    """Number of new tokens after which the recurrent states are kept a second time; 0: they are not."""


def decode(
    text_model: Any,
    memory: SlotMemory,
    places: Sequence[Place],
    embeds_BTH: Tensor,
    positions_3BT: Tensor,
    threads: Threads = ALONE,
) -> list[Tensor]:
    """Appends each row to its slot; returns final hidden states (num_wanted, H) per row.

    Rows must have different slots, and padding must be finite; positions may be on any device. Rows beyond ``places``
    are padding (LEAST_TOKENS).
    """
    assert len({place.slot for place in places}) == len(places), "two rows of one slot"
    num_new_B = torch.tensor([place.num_new for place in places], device=embeds_BTH.device)
    slot_B = torch.tensor([place.slot for place in places], device=embeds_BTH.device)
    num_kept_B = None
    if any(place.num_kept for place in places):
        num_kept_B = torch.tensor([place.num_kept for place in places], device=embeds_BTH.device)
    cos_sin = text_model.rotary_emb(embeds_BTH, positions_3BT.to(embeds_BTH.device))
    hidden = embeds_BTH
    last = len(text_model.layers) - 1
    for index, layer in enumerate(text_model.layers):
        normed_BTH = layer.input_layernorm(hidden)
        if index in memory.attention:
            # In the last layer only wanted tokens attend; the others need only their keys and values.
            num_queries = [place.num_wanted if index == last else place.num_new for place in places]
            mixed_BTH = _attention(
                layer.self_attn, memory.attention[index], places, num_queries, normed_BTH, cos_sin, threads
            )
        else:
            states = memory.recurrent[index]
            mixed_BTH = gated_delta(layer.linear_attn, states, slot_B, num_new_B, num_kept_B, normed_BTH)
        hidden = hidden + mixed_BTH
        if index == last:
            wanted = [slice(place.num_new - place.num_wanted, place.num_new) for place in places]
            hidden = torch.cat([row_TH[part] for row_TH, part in zip(hidden, wanted, strict=False)])
            hidden = F.pad(hidden, (0, 0, 0, max(0, LEAST_TOKENS - len(hidden))))
        hidden = hidden + layer.mlp(layer.post_attention_layernorm(hidden))
    num_wanted = [place.num_wanted for place in places]
    return list(text_model.norm(hidden)[: sum(num_wanted)].split(num_wanted))


def project(
    attention: Any, hidden_BTH: Tensor, cos_sin: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Queries, keys and values (B, heads, T, D), rotated by their positions, and the output gate (B, T, heads, D)."""
    projected = mixers.attention_inputs(attention, hidden_BTH)
    queries, keys, values = (each.transpose(1, 2) for each in projected[:3])
    return *mixers.rotate(queries, keys, *cos_sin), values, projected.gate


def _attention(
    attention: Any,
    memory: AttentionMemory,
    places: Sequence[Place],
    num_queries: Sequence[int],
    hidden_BTH: Tensor,
    cos_sin: tuple[Tensor, Tensor],
    threads: Threads,
) -> Tensor:
    """Stores every row's keys and values; output (B, T, H), zero except a row's last ``num_queries`` valid tokens."""
    queries, keys, values, gate = project(attention, hidden_BTH, cos_sin)
    seen = torch.zeros_like(gate)
    for row, (place, count) in enumerate(zip(places, num_queries, strict=True)):
        first, end = place.num_past, place.num_past + place.num_new
        memory.keys[place.slot, :, first:end] = keys[row, :, : place.num_new]
        memory.values[place.slot, :, first:end] = values[row, :, : place.num_new]
        if count:
            asking = slice(place.num_new - count, place.num_new)
            seen[row, asking] = attend(
                queries[row, :, asking], memory.keys[place.slot, :, :end], memory.values[place.slot, :, :end], threads
            ).transpose(0, 1)
    return mixers.attended(attention, seen, gate)


def gated_delta(
    delta: Any,
    memory: RecurrentMemory,
    slot_B: Tensor,
    num_new_B: Tensor,
    num_kept_B: Tensor | None,
    hidden_BTH: Tensor,
) -> Tensor:
    """Advances every row's states by its valid tokens; output (B, T, H), garbage in rows beyond the slots.

    ``num_kept_B`` (B,): tokens after which a row keeps its states a second time, 0 for not; None if no row does.
    """
    batch, length = len(slot_B), hidden_BTH.shape[1]
    width = delta.conv_kernel_size
    new_BTC, decay, beta, gate = mixers.delta_inputs(delta, hidden_BTH, batch)
    inputs_BCT = torch.cat([memory.conv[slot_B], new_BTC.transpose(1, 2)], dim=-1)

    def last(num_B: Tensor) -> Tensor:
        """The W inputs that end at a token: the last valid one, not the padding."""
        place_BW = num_B[:, None] + torch.arange(width, device=hidden_BTH.device)
        return inputs_BCT.gather(2, place_BW[:, None].expand(-1, inputs_BCT.shape[1], -1))

    memory.conv[slot_B] = last(num_new_B)
    mixed_BCT = F.silu(F.conv1d(inputs_BCT, delta.conv1d.weight, delta.conv1d.bias, groups=inputs_BCT.shape[1]))
    # With beta 0 and decay exp(0), padding leaves the state unchanged to the last bit.
    is_valid_BT1 = (torch.arange(length, device=hidden_BTH.device) < num_new_B[:, None])[..., None]
    read, state, kept = gated_delta_keeping(
        *mixers.heads(delta, mixed_BCT[..., -length:].transpose(1, 2)),
        g=decay * is_valid_BT1,
        beta=beta * is_valid_BT1,
        initial_state=memory.state[slot_B],
        num_kept_B=num_kept_B,
    )
    memory.state[slot_B] = state
    if num_kept_B is not None:
        Keep(memory.kept_conv, num_kept_B).put(slot_B, last(num_kept_B))
        Keep(memory.kept_state, num_kept_B).put(slot_B, kept)
    normed_BTX = mixers.normed(delta, read, gate)
    mixed_BTH: Tensor = delta.out_proj(F.pad(normed_BTX, (0, 0, 0, 0, 0, len(hidden_BTH) - batch)))
    return mixed_BTH
