"""Decodes the text of a transition greedily into its context.

It is a generator that yields appends and is sent their hidden states, so that the scheduler (``batching``) decides
which sessions share a forward.

# T tokens, N wanted ones, H hidden, V vocabulary
"""

from collections.abc import Generator, Sequence
from typing import Literal, TypeAlias, TypeVar

import torch
from torch import Tensor

from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.text_tokens import allowed_tokens, ends_of_text
from ponder_server.contract import ContextFull, Text
from ponder_server.draft import Draft
from ponder_server.runner import Append, SavedState, Session

Result = TypeVar("Result")
Steps: TypeAlias = Generator[Append, Tensor, Result]
"""Yields appends, is sent their wanted hidden states (N, H), returns a result."""

TextKind: TypeAlias = Literal["subgoal", "demo_reasoning"]

CLEARLY = 0.5
"""A lead in logits that no rounding makes up: bfloat16 has steps of at most 0.25 below 64."""

MAX_CHECKED_TOKENS = 16
"""Largest number of tokens in a decoding forward: the bucket after that of a single token."""


class TransitionWriter:
    """Appends O_t and [T_yes, S], or [T_yes, DR, T_yes, S], and always leaves room for the carriers.

    Which tokens end a text, which are masked, and what becomes of a text at its limit: the checkpoint's `TextPolicy`.
    An end token never enters the context.
    """

    def __init__(self, ponder: Ponder, draft: Draft, *, max_text_tokens: int) -> None:
        self._ponder = ponder
        self._draft = draft
        self._max_text_tokens = max_text_tokens
        self._t_yes = ponder.format.vocabulary.t_yes
        self._gate = (self._t_yes, ponder.format.vocabulary.t_no)
        self._policy = ponder.format.texts
        self._ends = ends_of_text(ponder.format.vocabulary, self._policy)
        self._is_text_V, self._may_end_V = allowed_tokens(ponder, ends=False), allowed_tokens(ponder, ends=True)

    def gate(self, hidden_1H: Tensor) -> tuple[bool, float]:
        """Whether T_yes is the most likely of all next tokens, and its probability against T_no alone.

        Mostly T_no leads it, and two rows of the head decide; the whole head is the largest matrix of the network. A
        third token may lead both, so that a probability above 1/2 opens nothing.
        """
        yes, no = self._ponder.logits(hidden_1H, self._gate)[0].tolist()
        opens = no - yes < CLEARLY and int(self._ponder.logits(hidden_1H)[0].argmax()) == self._t_yes
        return opens, float(torch.tensor(yes - no).sigmoid())

    def write(
        self,
        context: Session,
        before: SavedState,
        unread_ids: Sequence[int],
        unread_TH: Tensor,
        *,
        with_reasoning: bool,
        exactly: int | None,
    ) -> Steps[tuple[Text, ...]]:
        """Generates a transition into ``context``; DR first if ``with_reasoning``.

        ``before`` is the state before the observation, of which ``unread_ids`` are not in the context yet: all or none.

        DR ends with the T_yes that opens S, or at its limit, and S follows in both cases; T_no after DR ends the
        transition without S. ``exactly`` forces one text of this many tokens. Returns no text if one reached its limit
        and the policy is to roll back; the caller must then restore ``before``.

        Raises ContextFull if not even one token of each text fits; the caller must restore ``before``.
        """
        num_carriers = self._ponder.format.num_carriers
        t_yes_TH = self._ponder.embed([self._t_yes])
        opened = torch.cat([unread_TH, t_yes_TH])
        hidden_NH = yield Append(session=context, ids=[*unread_ids, self._t_yes], embeds_TH=opened, num_wanted=1)
        texts = []
        if with_reasoning and self._policy.reasoning == "owed":
            num_kept = 2 + num_carriers  # T_yes and one token of S
            limit = self._limit(context, before, num_kept, None)
            text, end = yield from self._decode(context, hidden_NH, "demo_reasoning", limit, None)
            if self._is_rolled_back(text):
                return ()
            texts.append(text)
            if end not in (self._t_yes, None):
                return tuple(texts)
            hidden_NH = yield Append(session=context, ids=[self._t_yes], embeds_TH=t_yes_TH)
        limit = self._limit(context, before, num_carriers, exactly)
        text, _ = yield from self._decode(context, hidden_NH, "subgoal", limit, exactly)
        if self._is_rolled_back(text):
            return ()
        return (*texts, *self._split(text))

    def _is_rolled_back(self, text: Text) -> bool:
        return text.truncated and self._policy.on_limit == "roll_back"

    def _split(self, text: Text) -> tuple[Text, ...]:
        """DR and S where the text has a T_yes inside; it stays in the context, and in neither text."""
        if self._t_yes not in text.token_ids:
            return (text,)
        at = text.token_ids.index(self._t_yes)
        return (
            self._text("demo_reasoning", text.token_ids[:at], truncated=False),
            self._text("subgoal", text.token_ids[at + 1 :], truncated=text.truncated),
        )

    def _limit(self, context: Session, before: SavedState, num_kept: int, exactly: int | None) -> int:
        """Limit of the next text's tokens if ``num_kept`` positions stay free. Raises ContextFull if that is < 1."""
        room = context.room - num_kept
        limit = min(self._max_text_tokens, room) if exactly is None else exactly
        if not 1 <= limit <= room:
            used = before.num_ids - context.num_forgotten  # length after the caller's restore
            wanted = context.num_tokens - used + max(limit, 1) + num_kept
            raise ContextFull(session=context.name, used=used, wanted=wanted, limit=context.max_tokens)
        return limit

    def _decode(
        self,
        context: Session,
        hidden_NH: Tensor,
        kind: TextKind,
        limit: int,
        exactly: int | None,
    ) -> Steps[tuple[Text, int | None]]:
        """Greedy text after the given hidden state, and its end token (None: it reached the limit).

        A draft is appended after the known token. If part of it is wrong the state is restored, which also undoes the
        right tokens: they become ``pending`` and are appended again with the next forward.
        """
        allowed_V = self._may_end_V if exactly is None else self._is_text_V
        ids: list[int] = []
        hidden_before = [hidden_NH]  # each token of the text, and the next one
        pending: list[int] = []
        end: int | None = None
        (token,) = self._greedy(hidden_NH, allowed_V)
        while True:
            if token in self._ends:
                end = token
                break
            if len(ids) == limit:
                break
            ids.append(token)
            pending.append(token)
            room = min(limit - len(ids), MAX_CHECKED_TOKENS - len(pending))
            draft = self._draft.propose(ids, room, torch.cat(hidden_before)) if room > 0 else ()
            before_draft = context.save(context.kept) if draft else None
            hidden_NH = yield self._append(context, [*pending, *draft], num_wanted=1 + len(draft))
            predicted = self._greedy(hidden_NH, allowed_V)
            num_right = next((i for i, guess in enumerate(draft) if guess != predicted[i]), len(draft))
            ids += draft[:num_right]
            hidden_before.append(hidden_NH[: num_right + 1])
            token = predicted[num_right]
            if before_draft is not None and num_right < len(draft):
                context.restore(before_draft)
                pending += draft[:num_right]
            else:
                pending = []
        if pending:
            yield self._append(context, pending, num_wanted=0)
        return self._text(kind, tuple(ids), truncated=end is None and exactly is None), end

    def _text(self, kind: TextKind, ids: tuple[int, ...], *, truncated: bool) -> Text:
        text = self._ponder.format.vocabulary.decode(ids)
        return Text(kind=kind, text=text, token_ids=ids, truncated=truncated)

    def _append(self, context: Session, ids: Sequence[int], *, num_wanted: int) -> Append:
        return Append(session=context, ids=ids, embeds_TH=self._ponder.embed(ids), num_wanted=num_wanted)

    def _greedy(self, hidden_NH: Tensor, allowed_V: Tensor) -> list[int]:
        """The most likely allowed token after each of N."""
        logits_NV = self._ponder.logits(hidden_NH).masked_fill(~allowed_V, float("-inf"))
        return logits_NV.argmax(dim=-1).tolist()  # type: ignore[no-any-return]
