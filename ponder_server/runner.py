"""Contexts on a device: append to several at once, save, restore, fork.

Contexts are append-only with one exception: the state saved before an append can be restored. That is cheap, because
only the recurrent layers overwrite their state, which is copied out and back; keys and values past the restored length
are simply no longer read.

Rows are padded on the right to one of a few *buckets*, so that forwards have few shapes; an append longer than the
largest bucket takes several forwards. A row's buckets do not depend on the other rows of its forwards. All memory is
allocated at construction, and all writes are in place.

# T new tokens, H hidden
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor

from dual_system.models.graphs import Capture
from dual_system.models.kernels.launch import Timer
from dual_system.models.ponder.network import Ponder
from ponder_server.captured import CapturedDecoder, check_captured
from ponder_server.contract import ContextFull, SessionError
from ponder_server.decoder import LEAST_TOKENS, Place, decode
from ponder_server.slots import SlotMemory
from ponder_server.threads import ALONE, Threads

NUM_SAVED_STATES = 2
"""Saved states per slot, allocated with it: before a query, and `Session.kept`."""

BUCKETS = (1, 16, 160, 512, 2048)
"""Padded row lengths: a decoded token, a verified draft, a fire of two 256 px cameras, pieces of a demonstration."""
_BUCKET_STEP = 16


def fitted(buckets: tuple[int, ...], num_query_ids: int) -> tuple[int, ...]:
    """The buckets, with one more for queries if they would otherwise be padded to twice their length."""
    own = -(-num_query_ids // _BUCKET_STEP) * _BUCKET_STEP
    padded = next((bucket for bucket in buckets if bucket >= num_query_ids), own)
    return tuple(sorted({*buckets, own})) if 2 * own <= padded else buckets


@dataclass(slots=True, kw_only=True, eq=False)
class SavedState:
    """A restore point of a session: lengths, and copies of the recurrent tensors."""

    num_ids: int
    next_position: int
    tensors: list[Tensor]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prefix:
    """A copy of a whole context, from which forks start. Its memory grows with its length."""

    ids: tuple[int, ...]
    next_position: int
    keys_and_values: tuple[Tensor, ...]
    states: tuple[Tensor, ...]

    @property
    def num_bytes(self) -> int:
        return sum(tensor.nbytes for tensor in (*self.keys_and_values, *self.states))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Append:
    """Tokens for one session; the hidden states of the last ``num_wanted`` are returned, of all if None."""

    session: "Session"
    ids: Sequence[int]
    embeds_TH: Tensor
    num_wanted: int | None = None
    num_kept: int = 0
    """After so many of the tokens the state goes to ``session.kept``, from where a restore goes on; 0: it does not."""


class Runner:
    """Appends to sessions of one network. Calls must run under ``torch.inference_mode``."""

    def __init__(
        self,
        ponder: Ponder,
        *,
        num_slots: int,
        max_tokens: int,
        buckets: tuple[int, ...] = BUCKETS,
        threads: Threads = ALONE,
    ) -> None:
        """``threads`` are for attention on a CPU only."""
        self._ponder = ponder
        self._threads = threads
        self._text_model = ponder.qwen.model.language_model
        self._buckets = buckets
        text_config = ponder.qwen.config.text_config
        self.memory = SlotMemory(
            text_config, num_slots=num_slots, max_tokens=max_tokens, device=ponder.device, dtype=ponder.dtype
        )
        self._captured: CapturedDecoder | None = None
        self._free_slots = list(reversed(range(num_slots)))
        self._saved = [
            (
                _blank_state([torch.empty_like(tensor) for tensor in self.memory.states(slot)]),
                _blank_state(self.memory.kept_states(slot)),
            )
            for slot in range(num_slots)
        ]

    def capture(self, capture: Capture, *, num_read: int, timer: Timer | None = None) -> None:
        """Turns on capturing of forwards (``captured``), at their first use or by :meth:`prepare`.

        Captured forwards keep their weights: replace none afterwards. They return at most ``num_read`` hidden states
        per row; a forward that needs more runs uncaptured. With a ``timer``, they try kernels.
        """
        self._captured = CapturedDecoder(self._text_model, self.memory, capture, num_read=num_read, timer=timer)

    def prepare(self, num_tokens: int, *, max_rows: int) -> int:
        """Captures all forwards for appends of up to ``num_tokens`` to up to ``max_rows`` sessions at once, and for any
        append to one session; returns the number of graphs, 0 without :meth:`capture`. Raises RuntimeError on failure.
        """
        if self._captured is None:
            return 0
        shared = [bucket for bucket in self._buckets if bucket <= self.bucket(num_tokens)]
        self._captured.prepare(shared, max_rows=min(max_rows, self.memory.num_slots))
        self._captured.prepare(self._buckets, max_rows=1)
        return len(self._captured)

    @property
    def kernels(self) -> str:
        """Which kernels captured forwards took and why not; "" if they tried none."""
        return "" if self._captured is None else self._captured.kernels

    def check(self, appended: Callable[[], Tensor]) -> None:
        """Raises RuntimeError if ``appended`` returns another result by replays than by the captured work itself."""
        assert self._captured is not None, "nothing is captured"
        replayed = appended()
        with self._captured.unrecorded():
            check_captured(replayed, appended())

    def open(self, name: str) -> "Session":
        """Opens an empty context in a free slot. Raises SessionError if no slot is free."""
        if not self._free_slots:
            raise SessionError(f"session {name!r} does not fit: all {self.memory.num_slots} slots are in use.")
        slot = self._free_slots.pop()
        self.memory.clear(slot)
        return Session(self, name, slot, *self._saved[slot])

    def close(self, session: "Session") -> None:
        """Frees the slot; the session must not be used again."""
        assert session.slot not in self._free_slots, "closed twice"
        self._free_slots.append(session.slot)

    def bucket(self, num_tokens: int) -> int:
        """Length of the next forward of a row with ``num_tokens`` left."""
        return next((bucket for bucket in self._buckets if bucket >= num_tokens), self._buckets[-1])

    def append(self, appends: Sequence[Append]) -> list[Tensor]:
        """Appends to different sessions in common forwards; returns hidden states (num_wanted, H) per append.

        Raises ContextFull, before anything changes, if one of them does not fit.
        """
        for one in appends:
            one.session.check_room(len(one.ids))
        rows = [_Row(one, self._ponder) for one in appends]
        while active := [row for row in rows if row.num_left]:
            length = max(self.bucket(row.num_left) for row in active)
            together = [row for row in active if self.bucket(row.num_left) == length]
            self._forward(together, length)
        for one, row in zip(appends, rows, strict=True):
            if one.num_kept:
                one.session.kept.num_ids = len(one.session.ids) + one.num_kept
                one.session.kept.next_position = row.kept_position
            one.session.ids.extend(one.ids)
            one.session.next_position = row.next_position
        return [torch.cat(row.hidden) if row.hidden else row.embeds_TH[:0] for row in rows]

    def _forward(self, rows: "Sequence[_Row]", length: int) -> None:
        num_rows = max(len(rows), -(-LEAST_TOKENS // length))
        embeds_BTH = rows[0].embeds_TH.new_zeros(num_rows, length, rows[0].embeds_TH.shape[1])
        positions_3BT = np.zeros((3, num_rows, length), dtype=np.int64)
        places = []
        for index, row in enumerate(rows):
            first, end = row.num_done, min(row.num_done + length, row.num_tokens)
            embeds_BTH[index, : end - first] = row.embeds_TH[first:end]
            positions_3BT[:, index, : end - first] = row.positions_3T[:, first:end]
            place = Place(
                slot=row.slot,
                num_past=row.num_past + first,
                num_new=end - first,
                num_wanted=max(0, end - max(first, row.first_wanted)),
                num_kept=row.num_kept - first if first < row.num_kept <= end else 0,
            )
            places.append(place)
            row.num_done = end
        positions = torch.from_numpy(positions_3BT)
        if self._captured is not None:
            hidden = self._captured(places, embeds_BTH, positions)
        else:
            hidden = decode(self._text_model, self.memory, places, embeds_BTH, positions, self._threads)
        for row, hidden_NH in zip(rows, hidden, strict=True):
            row.hidden.append(hidden_NH)


def _blank_state(tensors: list[Tensor]) -> SavedState:
    return SavedState(num_ids=0, next_position=0, tensors=tensors)


class _Row:
    """An append in progress."""

    def __init__(self, append: Append, ponder: Ponder) -> None:
        session = append.session
        self.embeds_TH = append.embeds_TH
        self.num_tokens, self.num_done = len(append.ids), 0
        self.slot, self.num_past = session.slot, session.num_tokens
        self.first_wanted = 0 if append.num_wanted is None else self.num_tokens - append.num_wanted
        positions_4T, self.next_position = ponder.format.positions(
            append.ids, first_index=session.num_tokens, first_position=session.next_position
        )
        self.positions_3T = positions_4T[1:]
        self.num_kept = append.num_kept
        if self.num_kept:
            _, self.kept_position = ponder.format.positions(
                append.ids[: self.num_kept], first_index=session.num_tokens, first_position=session.next_position
            )
        self.hidden: list[Tensor] = []

    @property
    def num_left(self) -> int:
        return self.num_tokens - self.num_done


class Session:
    """One context in a slot of its runner, which opens and closes it."""

    def __init__(self, runner: Runner, name: str, slot: int, before_fire: SavedState, kept: SavedState) -> None:
        self.before_fire = before_fire
        self.kept = kept
        """An append leaves it behind (`Append.num_kept`); once that is restored, a text saves its drafts' here."""
        self._runner = runner
        self._memory = runner.memory
        self.name = name
        self.slot = slot
        self.next_position = 0
        """mRoPE position of the next token."""
        self.ids: list[int] = []
        """Every token of the episode, as in its training row."""
        self.num_forgotten = 0
        """Number of tokens whose keys and values are gone (:meth:`keep`)."""

    @property
    def num_tokens(self) -> int:
        """Number of cached tokens, to which attention attends."""
        return len(self.ids) - self.num_forgotten

    @property
    def max_tokens(self) -> int:
        return self._memory.max_tokens

    @property
    def room(self) -> int:
        return self.max_tokens - self.num_tokens

    def check_room(self, num_new: int) -> None:
        """Raises ContextFull if ``num_new`` more tokens do not fit."""
        if num_new > self.room:
            raise ContextFull(session=self.name, used=self.num_tokens, wanted=num_new, limit=self.max_tokens)

    def append(self, ids: Sequence[int], embeds_TH: Tensor, *, num_wanted: int | None = None) -> Tensor:
        """:meth:`Runner.append` to this session alone."""
        append = Append(session=self, ids=ids, embeds_TH=embeds_TH, num_wanted=num_wanted)
        return self._runner.append([append])[0]

    def save(self, into: SavedState | None = None) -> SavedState:
        """Copies the state, into ``into`` if given (no allocation)."""
        tensors = self._memory.states(self.slot)
        if into is None:
            into = _blank_state([torch.empty_like(t) for t in tensors])
        for kept, tensor in zip(into.tensors, tensors, strict=True):
            kept.copy_(tensor)
        into.num_ids, into.next_position = len(self.ids), self.next_position
        return into

    def restore(self, saved: SavedState) -> None:
        """Goes back to a state saved since the last :meth:`keep`, and so undoes all appends since."""
        assert self.num_forgotten <= saved.num_ids <= len(self.ids), "a session can only go back"
        for tensor, kept in zip(self._memory.states(self.slot), saved.tensors, strict=True):
            tensor.copy_(kept)
        del self.ids[saved.num_ids :]
        self.next_position = saved.next_position

    def keep(self, ranges: Sequence[range]) -> None:
        """Keeps only these ranges of cached tokens, in ascending order; the recurrent states do not change."""
        kept = torch.tensor([index for indices in ranges for index in indices], dtype=torch.long)
        for tensor in self._memory.keys_and_values(self.slot, self.num_tokens):
            tensor[:, : len(kept)] = tensor[:, kept.to(tensor.device)]
        self.num_forgotten += self.num_tokens - len(kept)

    def fill(self, num_tokens: int) -> None:
        """Fills the context with meaningless tokens up to ``num_tokens``, to measure queries at that length."""
        for tensor in self._memory.keys_and_values(self.slot, num_tokens):
            tensor[:, self.num_tokens :] = 0.0
        num_more = num_tokens - self.num_tokens
        self.ids.extend([self.ids[-1]] * num_more)
        self.next_position += num_more

    def copy(self) -> Prefix:
        """A copy of this context, from which any number of sessions can start."""
        assert self.num_forgotten == 0, "a context with holes cannot be forked"
        return Prefix(
            ids=tuple(self.ids),
            next_position=self.next_position,
            keys_and_values=tuple(t.clone() for t in self._memory.keys_and_values(self.slot, self.num_tokens)),
            states=tuple(t.clone() for t in self._memory.states(self.slot)),
        )

    def start_from(self, prefix: Prefix) -> Self:
        """Replaces the contents of this session by a copied context. Raises ContextFull if it does not fit."""
        if len(prefix.ids) > self.max_tokens:
            raise ContextFull(session=self.name, used=0, wanted=len(prefix.ids), limit=self.max_tokens)
        own = (*self._memory.keys_and_values(self.slot, len(prefix.ids)), *self._memory.states(self.slot))
        for tensor, kept in zip(own, (*prefix.keys_and_values, *prefix.states), strict=True):
            tensor.copy_(kept)
        self.ids[:] = prefix.ids
        self.next_position = prefix.next_position
        return self
