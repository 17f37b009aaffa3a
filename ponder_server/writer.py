"""The text of a transition, decoded greedily and written into the context that it belongs to.

# T tokens, H hidden, V vocabulary
"""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from ponder_server.contract import ContextFull, Progress, Text
from ponder_server.runner import SavedState, Session
from ponderpounce.models.ponder import Ponder


class TransitionWriter:
    """Appends O_t and [T_yes, S], or [T_yes, DR, T_yes, S], and always leaves room for the carriers.

    T_no ends a text, as the end-of-text and end-of-turn tokens do; none of them enters the context. Other control
    tokens, carriers and unused rows cannot be said: a context cannot hold them as text. A text that reaches its
    limit is closed as it is.
    """

    def __init__(self, ponder: Ponder, *, max_text_tokens: int) -> None:
        self._ponder = ponder
        self._max_text_tokens = max_text_tokens
        v = ponder.format.vocabulary
        self._t_yes = v.t_yes
        self._ends = frozenset({v.t_yes, v.t_no, v.end_of_text, v.im_end})
        is_text_V = torch.zeros(ponder.vocab_size, dtype=torch.bool)
        is_text_V[: v.num_tokens] = True
        is_text_V[list(v.control_ids)] = False
        may_end_V = is_text_V.clone()
        may_end_V[list(self._ends)] = True
        self._is_text_V, self._may_end_V = is_text_V.to(ponder.device), may_end_V.to(ponder.device)

    def write(
        self,
        context: Session,
        before: SavedState,
        observation_ids: Sequence[int],
        observation_TH: Tensor,
        *,
        with_reasoning: bool,
        exactly: int | None,
        progress: Progress,
    ) -> tuple[Text, ...]:
        """Writes a transition into ``context``, which is at ``before``; DR first if ``with_reasoning``.

        DR is closed by the T_yes that opens S, or by its limit, and then S follows all the same; T_no after DR ends
        the transition without S. ``exactly``: one text of so many tokens whatever the model wants to say.

        Raises ContextFull if not even one token of each text fits; the caller restores ``before``.
        """
        num_carriers = self._ponder.format.num_carriers
        t_yes_TH = self._ponder.embed([self._t_yes])
        hidden_H = context.append([*observation_ids, self._t_yes], torch.cat([observation_TH, t_yes_TH]), num_wanted=1)[
            -1
        ]
        progress()
        texts = []
        if with_reasoning:
            num_kept = 2 + num_carriers  # T_yes and one token of S
            limit = self._limit(context, before, num_kept, None)
            text, end = self._decode(context, hidden_H, "demo_reasoning", limit, None, progress)
            texts.append(text)
            if end not in (self._t_yes, None):
                return tuple(texts)
            hidden_H = context.append([self._t_yes], t_yes_TH)[-1]
            progress()
        limit = self._limit(context, before, num_carriers, exactly)
        text, _ = self._decode(context, hidden_H, "subgoal", limit, exactly, progress)
        return (*texts, text)

    def _limit(self, context: Session, before: SavedState, num_kept: int, exactly: int | None) -> int:
        """Tokens the next text may have while ``num_kept`` positions stay free; ContextFull if that is too few."""
        room = context.room - num_kept
        limit = min(self._max_text_tokens, room) if exactly is None else exactly
        if not 1 <= limit <= room:
            used = before.num_tokens  # what the session goes back to
            wanted = context.num_tokens - used + max(limit, 1) + num_kept
            raise ContextFull(session=context.name, used=used, wanted=wanted, limit=context.max_tokens)
        return limit

    def _decode(
        self,
        context: Session,
        hidden_H: Tensor,
        kind: Literal["subgoal", "demo_reasoning"],
        limit: int,
        exactly: int | None,
        progress: Progress,
    ) -> tuple[Text, int | None]:
        """Greedy text after the given hidden state, and the token that ended it (None: the limit did)."""
        sayable_V = self._may_end_V if exactly is None else self._is_text_V
        ids: list[int] = []
        end: int | None = None
        while len(ids) != exactly:
            logits_V = self._ponder.logits(hidden_H[None])[0]
            token = int(logits_V.masked_fill(~sayable_V, float("-inf")).argmax())
            if token in self._ends:
                end = token
                break
            if len(ids) == limit:
                break
            ids.append(token)
            hidden_H = context.append([token], self._ponder.embed([token]))[-1]
            progress()
        text = Text(
            kind=kind,
            text=self._ponder.format.vocabulary.decode(ids),
            token_ids=tuple(ids),
            truncated=end is None and exactly is None,
        )
        return text, end
