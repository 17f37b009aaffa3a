"""Drafts from a checkpoint's own multi-token prediction.

The head attends only to the text being generated: its past is a function of the writer's arguments, so there is no
second cache to restore, fork and forget along with the first. Earlier context reaches it through the network's hidden
states. It was trained with attention to the whole context; that could improve drafts but never change texts.

# T tokens of the text, H hidden, R rows of the LM head
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dual_system.models.graphs import Capture
from dual_system.models.ponder.mtp import MtpHead
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.text_tokens import allowed_tokens, ends_of_text
from ponder_server.captured import CapturedDecoder
from ponder_server.decoder import Place, decode
from ponder_server.draft import Draft
from ponder_server.slots import SlotMemory
from ponder_server.writer import MAX_CHECKED_TOKENS

WINDOW = 64
"""Tokens of the text to which the head attends; they are recomputed for every proposal."""
MAX_DRAFT_TOKENS = MAX_CHECKED_TOKENS - 1
NUM_ROWS = 32_768
"""Tokens that it guesses: the first of the vocabulary. Byte pair encoding numbers tokens as it finds them, and finds
frequent ones early. To read the whole head for a guess would take a 9B network longer than the block itself."""
_LENGTHS = (1, 16, WINDOW)


class MtpDraft(Draft):
    """Proposes ``num_tokens`` at a time, fewer where the head predicts the end of the text."""

    def __init__(self, ponder: Ponder, *, num_tokens: int) -> None:
        """Raises ValueError if ``num_tokens`` cannot be verified in one forward, and as :class:`MtpHead`."""
        if not 1 <= num_tokens <= MAX_DRAFT_TOKENS:
            raise ValueError(f"{num_tokens} tokens at a time were asked for; 1 to {MAX_DRAFT_TOKENS} can be checked.")
        self._ponder = ponder
        self._num_tokens = num_tokens
        self._head = MtpHead(ponder)
        max_tokens, config = WINDOW + num_tokens, self._head.text_config
        self._memory = SlotMemory(config, num_slots=1, max_tokens=max_tokens, device=ponder.device, dtype=ponder.dtype)
        self._ends = ends_of_text(ponder.format.vocabulary, ponder.format.texts)
        is_guessed_V = allowed_tokens(ponder, ends=True)
        is_guessed_V[[row for row in range(NUM_ROWS, ponder.vocab_size) if row not in self._ends]] = False
        self._token_R = is_guessed_V.nonzero()[:, 0]
        self._rows_RH: Tensor = ponder.qwen.lm_head.weight.detach()[self._token_R]
        self._captured: CapturedDecoder | None = None
        self.parts: Sequence[nn.Module] = [layer.mlp for layer in self._head.layers]  # type: ignore[misc]

    def capture(self, capture: Capture) -> None:
        self._captured = CapturedDecoder(self._head, self._memory, capture, num_read=1)
        self._captured.prepare(_LENGTHS, max_rows=1)

    def propose(self, written: Sequence[int], max_tokens: int, hidden_TH: Tensor | None = None) -> tuple[int, ...]:
        assert hidden_TH is not None, "this draft reads hidden states"
        assert len(hidden_TH) == len(written) > 0, "a hidden state before every token"
        ids, hidden = list(written[-WINDOW:]), hidden_TH[-WINDOW:]
        guesses: list[int] = []
        num_past = 0
        while len(guesses) < min(max_tokens, self._num_tokens):
            hidden = self._last_hidden(ids, hidden, num_past)
            token = int(self._token_R[F.linear(hidden, self._rows_RH)[0].argmax()])
            if token in self._ends:
                break
            num_past += len(ids)
            guesses.append(token)
            ids = [token]
        return tuple(guesses)

    def _last_hidden(self, ids: Sequence[int], hidden_TH: Tensor, num_past: int) -> Tensor:
        """Appends tokens to the head's own past; returns its output (1, H) at the last of them."""
        place = Place(slot=0, num_past=num_past, num_new=len(ids), num_wanted=1)
        merged_TH = self._head.merge(self._ponder.embed(ids), hidden_TH)
        positions_3BT = torch.arange(num_past, num_past + len(ids)).expand(3, 1, -1)
        if self._captured is None:
            (last_1H,) = decode(self._head, self._memory, [place], merged_TH[None], positions_3BT)
            return last_1H
        padding = next(length for length in _LENGTHS if length >= len(ids)) - len(ids)
        padded_BTH = F.pad(merged_TH, (0, 0, 0, padding))[None]
        (last_1H,) = self._captured([place], padded_BTH, F.pad(positions_3BT, (0, padding)))
        return last_1H
