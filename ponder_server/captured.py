"""A forward pass over several contexts that can be captured as a CUDA graph: all varying numbers are device tensors.

``decoder.decode`` uses Python numbers for slots, lengths of the past, new tokens and wanted hidden states; here they
are index tensors. A shape is rows, tokens per row, and positions that attention reads. A forward of one shape is always
the same operations, so its CUDA graph serves every slot and every length. The tests compare it with ``decode`` on a
CPU, where it runs without a graph.

Attention gathers the slots' keys and values, and repeats the first position in place of those past the last one. So it
reads only valid memory. It computes at most twice as much as with the exact length, because buckets are powers of two.

# B rows, T tokens of a row with its padding, H hidden, D head dimension, Q query heads, G key heads
# K positions that are read, W hidden states returned per row
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from dual_system.models.graphs import Capture, Work
from ponder_server.decoder import Place, decode, gated_delta, project
from ponder_server.slots import AttentionMemory, SlotMemory

LEAST_POSITIONS = 1024
"""Smallest bucket of positions: shorter ones would save no time on a GPU, and each is another graph."""

MOST_CHANGE = 1e-3
"""Largest relative L2 change of cognition by capturing. The recorded operations are the same, so it should be 0 in any
dtype. The eager path is no yardstick: in bfloat16 two right evaluations of 32 layers may differ by 6e-2."""


def position_buckets(max_tokens: int, least: int = LEAST_POSITIONS) -> tuple[int, ...]:
    """``least`` times powers of two, then ``max_tokens`` up to a multiple of 64; a context of at least ``least`` fills
    half of its bucket. torch's memory-efficient kernel errs at some other lengths with shared keys (pytorch#191937)."""
    buckets = []
    while least < max_tokens:
        buckets.append(least)
        least *= 2
    return (*buckets, -(-max_tokens // 64) * 64)


def check_captured(replayed_KH: Tensor, direct_KH: Tensor) -> None:
    """Raises RuntimeError unless a replay's cognition is the one of the same work run directly.

    It detects a driver that records wrongly before a robot moves.
    """
    change = float((replayed_KH - direct_KH).norm() / direct_KH.norm())
    if not change <= MOST_CHANGE:  # also refuses NaN
        raise RuntimeError(
            f"captured forwards change cognition by {change:.1e} (relative L2) against the same ones run directly; "
            f"expected 0, at most {MOST_CHANGE:.0e}. ponder-serve --no-graphs does without graphs; please report it."
        )


class CapturedDecoder:
    """Forwards over one memory; each shape is captured at its first use.

    ``max_rows`` rows, ``b`` lengths and ``k`` position buckets need at most ``max_rows * b * k`` graphs.
    """

    def __init__(
        self,
        text_model: Any,
        memory: SlotMemory,
        capture: Capture,
        *,
        num_read: int,
        least_positions: int = LEAST_POSITIONS,
    ) -> None:
        """``num_read``: most hidden states returned per row; a forward that needs more runs through ``decode``."""
        self._text_model = text_model
        self._memory = memory
        self._capture = capture
        self._num_read = num_read
        self.position_buckets = position_buckets(memory.max_tokens, least_positions)
        self._forwards: dict[tuple[int, int, int], Forward] = {}
        self._replays = True

    def __len__(self) -> int:
        """Number of captured graphs."""
        return len(self._forwards)

    def __call__(self, places: Sequence[Place], embeds_BTH: Tensor, positions_3BT: Tensor) -> list[Tensor]:
        """Appends each row to its slot and returns final hidden states (num_wanted, H) per row, as ``decode`` does.

        No row may be idle. Padding rows beyond ``places`` are dropped.
        """
        assert len({place.slot for place in places}) == len(places), "two rows of one slot"
        assert all(place.num_new for place in places), "an idle row"
        num_rows, length = len(places), embeds_BTH.shape[1]
        if max(place.num_wanted for place in places) > min(length, self._num_read):
            return decode(self._text_model, self._memory, places, embeds_BTH, positions_3BT)
        longest = max(place.num_past + place.num_new for place in places)
        num_positions = next(bucket for bucket in self.position_buckets if bucket >= longest)
        forward = self.forward(num_rows, length, num_positions)
        forward.load(places, embeds_BTH[:num_rows], positions_3BT[:, :num_rows])
        (forward.run if self._replays else forward.work)()
        return forward.hidden(places)

    @contextmanager
    def unrecorded(self) -> Iterator[None]:
        """Runs the captured work itself in place of its replays, to compare the two."""
        self._replays = False
        try:
            yield
        finally:
            self._replays = True

    def prepare(self, lengths: Sequence[int], *, max_rows: int) -> None:
        """Captures every forward of 1 to ``max_rows`` rows of these lengths, for all position buckets.

        Raises RuntimeError if the device has not enough memory or cannot record them; the message has the way out.
        """
        # Large ones first, so that the others reuse their memory in the pool.
        for shape in product(range(max_rows, 0, -1), sorted(lengths, reverse=True), reversed(self.position_buckets)):
            try:
                self.forward(*shape)
            except RuntimeError as error:
                raise RuntimeError(
                    f"the forward of {shape[0]} rows of {shape[1]} tokens over {shape[2]} positions could not be "
                    f"captured after {len(self)} others: {error}. If memory lacks, lower --max-sessions or "
                    "--max-context-tokens; ponder-serve --no-graphs does without graphs."
                ) from error

    def forward(self, num_rows: int, length: int, num_positions: int) -> "Forward":
        """The forward of this shape. Captures it if it is new, which leaves the memory unchanged."""
        key = (num_rows, length, num_positions)
        if key not in self._forwards:
            num_read = min(length, self._num_read)
            self._forwards[key] = Forward(self._text_model, self._memory, key, num_read, self._capture)
        return self._forwards[key]


class Forward:
    """Static buffers of one shape, and the captured work over them."""

    def __init__(
        self, text_model: Any, memory: SlotMemory, shape: tuple[int, int, int], num_read: int, capture: Capture
    ) -> None:
        num_rows, length, num_positions = shape
        self._text_model = text_model
        self._memory = memory
        self._num_positions = num_positions
        weight: Tensor = text_model.norm.weight
        self._embeds_BTH = weight.new_zeros(num_rows, length, len(weight))
        self._hidden_BWH = weight.new_zeros(num_rows, num_read, len(weight))
        # All numbers in one tensor, for one copy to the device.
        self._numbers = torch.zeros((4 + 3 * length) * num_rows, dtype=torch.long, device=weight.device)
        rows, positions = self._numbers.split([4 * num_rows, 3 * length * num_rows])
        self._slot_B, self._num_past_B, self._num_new_B, self._num_wanted_B = rows.view(4, num_rows)
        self._positions_3BT = positions.view(3, num_rows, length)
        self.run: Work = self._captured(capture)

    def load(self, places: Sequence[Place], embeds_BTH: Tensor, positions_3BT: Tensor) -> None:
        """Fills the buffers; padding must be finite."""
        self._embeds_BTH.copy_(embeds_BTH)
        rows = [[getattr(p, name) for p in places] for name in ("slot", "num_past", "num_new", "num_wanted")]
        self._numbers.copy_(torch.cat([torch.tensor(rows).flatten(), positions_3BT.cpu().flatten()]))

    def hidden(self, places: Sequence[Place]) -> list[Tensor]:
        """Hidden states (num_wanted, H) per row of the last run; copies, because the next run overwrites them."""
        return [row_WH[: place.num_wanted].clone() for row_WH, place in zip(self._hidden_BWH, places, strict=True)]

    def _captured(self, capture: Capture) -> Work:
        """Captures the work. Capturing runs it, which appends to the beginning of slot 0; that is restored after."""
        self._num_new_B.fill_(1)
        changed = [*self._memory.states(0), *self._memory.keys_and_values(0, 1)]
        kept = [tensor.clone() for tensor in changed]
        try:
            return capture(self.work)
        finally:
            for tensor, was in zip(changed, kept, strict=True):
                tensor.copy_(was)

    def work(self) -> None:
        """``decode`` without Python numbers: what is captured."""
        device, length = self._embeds_BTH.device, self._embeds_BTH.shape[1]
        token_T = torch.arange(length, device=device)
        num_read = self._hidden_BWH.shape[1]
        read_BW = (self._num_new_B - self._num_wanted_B)[:, None] + token_T[:num_read]
        read_BW.clamp_(0, length - 1)
        row_B1 = torch.arange(len(read_BW), device=device)[:, None]
        window = _Window(self._slot_B, self._num_past_B, self._num_new_B, token_T, self._num_positions)
        cos_sin = self._text_model.rotary_emb(self._embeds_BTH, self._positions_3BT)
        bias_BTK = window.bias(self._embeds_BTH.dtype)
        hidden, last = self._embeds_BTH, len(self._text_model.layers) - 1
        for index, layer in enumerate(self._text_model.layers):
            normed_BTH = layer.input_layernorm(hidden)
            if index in self._memory.attention:
                # The last layer computes only the wanted queries.
                asking_BW = (row_B1, read_BW) if index == last else None
                mixed = _attention(
                    layer.self_attn, self._memory.attention[index], window, normed_BTH, cos_sin, bias_BTK, asking_BW
                )
            else:
                memory = self._memory.recurrent[index]
                mixed = gated_delta(layer.linear_attn, memory, self._slot_B, self._num_new_B, normed_BTH)
                mixed = mixed[row_B1, read_BW] if index == last else mixed
            hidden = (hidden[row_B1, read_BW] if index == last else hidden) + mixed
            hidden = hidden + layer.mlp(layer.post_attention_layernorm(hidden))
        self._hidden_BWH.copy_(self._text_model.norm(hidden))


class _Window:
    """Indices at which rows write and read keys and values, in the first K positions of their slots."""

    def __init__(
        self, slot_B: Tensor, num_past_B: Tensor, num_new_B: Tensor, token_T: Tensor, num_positions: int
    ) -> None:
        num_past_B1, num_new_B1 = num_past_B[:, None], num_new_B[:, None]
        position_K = torch.arange(num_positions, device=token_T.device)
        self.slot_B1 = slot_B[:, None]
        self.stored_BT = token_T * (token_T < num_new_B1)
        """Tokens whose keys and values are written. Padding repeats the first token, so that the order of writes does
        not matter: the slot may end before the bucket does, so padding has no place of its own."""
        self.places_BT = num_past_B1 + self.stored_BT
        self.seen_BK = position_K * (position_K < num_past_B1 + num_new_B1)
        """Positions that are read; those past the last one hold garbage, which may be NaN, and are replaced by 0."""
        self._is_visible_BTK = position_K <= (num_past_B1 + token_T)[..., None]

    def bias(self, dtype: torch.dtype) -> Tensor:
        """Causal attention bias (B, T, K). Padding attends to something too, so that no row is NaN."""
        is_hidden_BTK = ~self._is_visible_BTK
        return torch.zeros_like(is_hidden_BTK, dtype=dtype).masked_fill_(is_hidden_BTK, float("-inf"))

    def store(self, memory: Tensor, new_BGTD: Tensor) -> None:
        """Writes the rows' new keys or values (B, G, T, D) into ``memory`` (N, G, S, D)."""
        stored_BT1 = self.stored_BT[:, :, None, None].expand(-1, -1, new_BGTD.shape[1], new_BGTD.shape[3])
        memory[self.slot_B1, :, self.places_BT] = new_BGTD.transpose(1, 2).gather(1, stored_BT1)

    def read(self, memory: Tensor) -> Tensor:
        """The rows' keys or values (B, G, K, D)."""
        head_G1 = torch.arange(memory.shape[1], device=memory.device)[:, None]
        return memory[self.slot_B1[..., None], head_G1, self.seen_BK[:, None]]


def _attention(
    attention: Any,
    memory: AttentionMemory,
    window: _Window,
    hidden_BTH: Tensor,
    cos_sin: tuple[Tensor, Tensor],
    bias_BTK: Tensor,
    asking: tuple[Tensor, Tensor] | None,
) -> Tensor:
    """Stores every row's keys and values; attention output (B, T, H), or (B, W, H) of the tokens ``asking``."""
    queries, keys, values, gate = project(attention, hidden_BTH, cos_sin)
    window.store(memory.keys, keys)
    window.store(memory.values, values)
    if asking is not None:
        queries, gate, bias_BTK = queries.transpose(1, 2)[asking].transpose(1, 2), gate[asking], bias_BTK[asking]
    seen_BTQD = _attend(queries, window.read(memory.keys), window.read(memory.values), bias_BTK).transpose(1, 2)
    mixed: Tensor = attention.o_proj((seen_BTQD.reshape(gate.shape) * gate.sigmoid()).flatten(2))
    return mixed


def _attend(queries_BQTD: Tensor, keys_BGKD: Tensor, values_BGKD: Tensor, bias_BTK: Tensor) -> Tensor:
    """Attention output (B, Q, T, D). Key heads become rows and their query heads the heads: torch's kernels with masks
    do not support grouped heads, and repeating the keys would copy them for every query head."""
    num_rows, num_heads, num_queries, head_dim = queries_BQTD.shape
    num_key_heads = keys_BGKD.shape[1]
    group = num_heads // num_key_heads

    def shared(x_BGKD: Tensor) -> Tensor:
        return x_BGKD.flatten(0, 1)[:, None].expand(-1, group, -1, -1)

    bias = bias_BTK[:, None].expand(-1, num_key_heads, -1, -1).flatten(0, 1)[:, None].expand(-1, group, -1, -1)
    queries = queries_BQTD.reshape(num_rows * num_key_heads, group, num_queries, head_dim)
    seen = F.scaled_dot_product_attention(queries, shared(keys_BGKD), shared(values_BGKD), attn_mask=bias)
    return seen.view(queries_BQTD.shape)
