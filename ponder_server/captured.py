"""A forward pass over several contexts that can be captured as a CUDA graph: all varying numbers are device tensors.

``decoder.decode`` uses Python numbers for slots, lengths of the past, new tokens and wanted hidden states; here they
are index tensors. A shape is rows, tokens per row, and positions that attention reads. A forward of one shape is always
the same operations, so its CUDA graph serves every slot and every length. The tests compare it with ``decode`` on a
CPU, where it runs without a graph.

Without its kernel, attention gathers the slots' keys and values, and repeats the first position in place of those past
the last one. So it reads only valid memory. It computes at most twice as much as with the exact length, because buckets
are powers of two.

# B rows, T tokens of a row with its padding, R = B T, H hidden, W hidden states returned per row
"""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from typing import Any

import torch
from torch import Tensor

from dual_system.models.fp8 import Fp8Linear
from dual_system.models.gpu import send
from dual_system.models.graphs import Capture, Work
from dual_system.models.kernels.fp8 import FEW_ROWS, Quantised
from dual_system.models.kernels.launch import Timer
from dual_system.models.kernels.rms_norm import Residual, Style
from dual_system.models.kernels.trial import Verdict, choose, told
from ponder_server.decoder import Place, decode
from ponder_server.kernels.rotate_store import Projected, Window
from ponder_server.operations import KERNELS, TWINS, Operations
from ponder_server.rehearsal import rehearse
from ponder_server.slots import Keep, SlotMemory
from ponder_server.stack import AttentionLayer, Product, Stack

log = logging.getLogger(__name__)

_NUMBERS = ("slot", "num_past", "num_new", "num_wanted", "num_kept")

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


def check_captured(replayed: Tensor, direct: Tensor, what: str = "forwards change cognition") -> None:
    """Raises RuntimeError unless a replay's result is the one of the same work run directly.

    It detects a driver that records wrongly before a robot moves.
    """
    change = float((replayed.float() - direct.float()).norm() / direct.float().norm())
    if not change <= MOST_CHANGE:  # also refuses NaN
        raise RuntimeError(
            f"captured {what} by {change:.1e} (relative L2) against the same ones run directly; "
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
        timer: Timer | None = None,
    ) -> None:
        """``num_read``: most hidden states returned per row; a forward that needs more runs through ``decode``.

        With a ``timer``, kernels are tried (``operations``); without one the twins run.
        """
        self._text_model = text_model
        self._stack = Stack.of(text_model)
        self._timer = timer
        self._operations: dict[tuple[int, int], Operations] = {}
        self._tried: dict[str, list[Verdict]] = {}
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
        buckets = self._buckets(num_rows, length)
        forward = self.forward(num_rows, length, next(bucket for bucket in buckets if bucket >= longest))
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
        for num_rows, length in product(range(max_rows, 0, -1), sorted(lengths, reverse=True)):
            for num_positions in reversed(self._buckets(num_rows, length)):
                try:
                    self.forward(num_rows, length, num_positions)
                except RuntimeError as error:
                    raise RuntimeError(
                        f"the forward of {num_rows} rows of {length} tokens over {num_positions} positions could not "
                        f"be captured after {len(self)} others: {error}. If memory lacks, lower --max-sessions or "
                        "--max-context-tokens; ponder-serve --no-graphs does without graphs."
                    ) from error

    def forward(self, num_rows: int, length: int, num_positions: int) -> "Forward":
        """The forward of this shape. Captures it if it is new, which leaves the memory unchanged."""
        key = (num_rows, length, num_positions)
        if key not in self._forwards:
            operations = self.operations(num_rows, length)
            num_read = min(length, self._num_read)
            self._forwards[key] = Forward(self._stack, self._memory, operations, key, num_read, self._capture)
        return self._forwards[key]

    def operations(self, num_rows: int, length: int) -> Operations:
        """What forwards of these rows run between their products; kernels are tried at the first use."""
        key = (num_rows, length)
        if self._timer is None:
            return TWINS
        if key not in self._operations:
            samples = rehearse(self._stack, self._memory, num_rows=num_rows, length=length)
            self._operations[key], verdicts = choose(samples, TWINS, KERNELS, self._timer)
            self._tried[f"{num_rows}x{length}"] = verdicts
            for verdict in verdicts:
                taken = "kernel" if verdict.is_taken else "twin"
                log.info("rows=%d tokens=%d %s: %s, %s", num_rows, length, verdict.operation, taken, verdict.why)
        return self._operations[key]

    @property
    def kernels(self) -> str:
        """Which kernels were taken, of how many shapes of rows x tokens, and why not."""
        return told(self._tried)

    def _buckets(self, num_rows: int, length: int) -> tuple[int, ...]:
        """Numbers of positions of which each is a graph; the kernel reads what is valid, so that one serves all."""
        is_any = self.operations(num_rows, length).attend is KERNELS.attend
        return self.position_buckets[-1:] if is_any else self.position_buckets


class Forward:
    """Static buffers of one shape, and the captured work over them."""

    def __init__(
        self,
        stack: Stack,
        memory: SlotMemory,
        operations: Operations,
        shape: tuple[int, int, int],
        num_read: int,
        capture: Capture,
    ) -> None:
        num_rows, length, num_positions = shape
        self._stack = stack
        self._memory = memory
        self._operations = operations
        self._num_positions = num_positions
        weight = stack.norm.scale.to(stack.dtype)
        self._embeds_BTH = weight.new_zeros(num_rows, length, len(weight))
        self._hidden_BWH = weight.new_zeros(num_rows, num_read, len(weight))
        # All numbers in one tensor, for one copy to the device.
        self._numbers = torch.zeros((5 + 3 * length) * num_rows, dtype=torch.long, device=weight.device)
        rows, positions = self._numbers.split([5 * num_rows, 3 * length * num_rows])
        (self._slot_B, self._num_past_B, self._num_new_B, self._num_wanted_B, self._num_kept_B) = rows.view(5, num_rows)
        self._positions_3BT = positions.view(3, num_rows, length)
        self.run: Work = self._captured(capture)

    def load(self, places: Sequence[Place], embeds_BTH: Tensor, positions_3BT: Tensor) -> None:
        """Fills the buffers; padding must be finite."""
        self._embeds_BTH.copy_(embeds_BTH)
        rows = [[getattr(p, name) for p in places] for name in _NUMBERS]
        send(torch.cat([torch.tensor(rows).flatten(), positions_3BT.cpu().flatten()]), self._numbers)

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
        do, stack, memory = self._operations, self._stack, self._memory
        num_rows, length, width = self._embeds_BTH.shape
        token_T = torch.arange(length, device=self._embeds_BTH.device)
        num_read = self._hidden_BWH.shape[1]
        read_BW = ((self._num_new_B - self._num_wanted_B)[:, None] + token_T[:num_read]).clamp_(0, length - 1)
        all_BT = token_T.repeat(num_rows, 1)
        row_B1 = torch.arange(num_rows, device=token_T.device)[:, None]
        window = Window(self._slot_B, self._num_past_B, self._num_new_B)
        cos_sin = stack.rotary(self._embeds_BTH, self._positions_3BT)
        hidden_RH, branch_RH = self._embeds_BTH.view(-1, width).clone(), None

        # Few rows take the weights alone in fp8, if that kernel was taken; more are quantised and multiplied in fp8.
        is_few = do.few_rows is not TWINS.few_rows and num_rows * length <= FEW_ROWS
        multiplies = stack.multiplies_fp8 and not is_few

        def quantised(x: Tensor) -> Quantised | None:
            return do.quantise(x.reshape(-1, x.shape[-1])) if multiplies else None

        def times(x: Tensor, linear: Product, rows: Quantised | None) -> Tensor:
            """``x`` times a layer's weight, (..., O); ``rows`` are ``x`` in fp8."""
            if rows is not None and isinstance(linear, Fp8Linear):
                return linear.product_of(rows).view(*x.shape[:-1], -1)
            if is_few and isinstance(linear, Fp8Linear) and linear.multiplies:
                few_RO: Tensor = do.few_rows(x.reshape(-1, x.shape[-1]), linear.weight_OI, linear.scale_O)
                return few_RO.view(*x.shape[:-1], -1)
            return linear(x)

        def normed(style: Style) -> tuple[Tensor, Quantised | None]:
            """Adds the last branch to the stream; the norm of the sum, and that in fp8."""
            out_RH = torch.empty_like(hidden_RH)
            rows = Quantised.blank(out_RH) if multiplies else None
            do.norm(hidden_RH, out_RH, style, None if branch_RH is None else Residual(branch_RH), rows)
            return out_RH, rows

        for layer in stack.layers:
            normed_RH, rows = normed(layer.input_norm)
            normed_BTH = normed_RH.view(num_rows, -1, width)
            # The last layer computes only what is wanted.
            asking_BW = read_BW if layer is stack.layers[-1] else all_BT
            if isinstance(layer.mixer, AttentionLayer):
                keys, values = memory.attention[layer.index].keys, memory.attention[layer.index].values
                projected = Projected(*(times(normed_BTH, product, rows) for product in layer.mixer.inputs))
                queries = do.rotate_store(projected, layer.mixer.norms, cos_sin, keys, values, window)
                seen_BWX = do.attend(
                    queries, projected.query_gate_BTX, keys, values, asking_BW, window, self._num_positions
                )
                mixed_BWH = times(seen_BWX, layer.mixer.out, quantised(seen_BWX))
            else:
                delta, states = layer.mixer, memory.recurrent[layer.index]
                inputs_BTC = times(normed_BTH, delta.inputs, rows)
                keep_conv, keep_state = (
                    Keep(memory_NX, self._num_kept_B) for memory_NX in (states.kept_conv, states.kept_state)
                )
                mixed = do.conv_silu(inputs_BTC, delta.conv_CW, states.conv, self._slot_B, self._num_new_B, keep_conv)
                speed_beta = delta.speed_beta(normed_BTH)
                read_BTVE = do.delta(
                    *(mixed, speed_beta, delta.a_log_V, delta.dt_bias_V),
                    *(states.state, self._slot_B, self._num_new_B, keep_state),
                )
                gate_RX = times(normed_RH, delta.gate, rows)
                read_RVE = read_BTVE.reshape(num_rows * length, *read_BTVE.shape[2:])
                gated_RX = do.gated_norm(read_RVE, gate_RX, delta.norm_E, delta.eps)
                mixed_BWH = times(gated_RX, delta.out, quantised(gated_RX)).view(num_rows, length, -1)
                mixed_BWH = mixed_BWH[row_B1, read_BW] if layer is stack.layers[-1] else mixed_BWH
            if layer is stack.layers[-1]:
                hidden_RH = hidden_RH.view(num_rows, length, width)[row_B1, read_BW].view(-1, width)
            branch_RH = mixed_BWH.reshape(-1, width)
            normed_RH, rows = normed(layer.mlp_norm)
            active_RM = do.swiglu(times(normed_RH, layer.gate, rows), times(normed_RH, layer.up, rows))
            branch_RH = times(active_RM, layer.down, quantised(active_RM))
        assert branch_RH is not None, "a stack has layers"
        do.norm(hidden_RH, self._hidden_BWH.view(hidden_RH.shape), stack.norm, Residual(branch_RH))
