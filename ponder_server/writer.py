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
from dual_system.models.ponder.vocabulary import Vocabulary
from ponder_server.contract import ContextFull, Text
from ponder_server.draft import Draft
from ponder_server.runner import Append, SavedState, Session

Result = TypeVar("Result")
Steps: TypeAlias = Generator[Append, Tensor, Result]
"""Yields appends, is sent their wanted hidden states (N, H), returns a result."""

MAX_CHECKED_TOKENS = 16
"""Largest number of tokens in a decoding forward: the bucket after that of a single token."""


def ends_of_text(vocabulary: Vocabulary) -> frozenset[int]:
    """Tokens that end a text and are not part of it."""
    return frozenset({vocabulary.t_yes, vocabulary.t_no, vocabulary.end_of_text, vocabulary.im_end})


def allowed_tokens(ponder: Ponder, *, ends: bool) -> Tensor:
    """Tokens allowed in a text, (V,) bool: no control tokens, carriers or unused rows; end tokens if ``ends``."""
    vocabulary = ponder.format.vocabulary
    is_text_V = torch.zeros(ponder.vocab_size, dtype=torch.bool)
    is_text_V[: vocabulary.num_tokens] = True
    is_text_V[list(vocabulary.control_ids)] = False
    is_text_V[list(ends_of_text(vocabulary))] = ends
    return is_text_V.to(ponder.device)


class TransitionWriter:
    """Appends O_t and [T_yes, S], or [T_yes, DR, T_yes, S], and always leaves room for the carriers.

    T_no ends a text, as the end-of-text and end-of-turn tokens do; none of them enters the context. Other control
    tokens, carriers and unused rows are masked, because they are no text. A text that reaches its limit is cut.
    """

    def __init__(self, ponder: Ponder, draft: Draft, *, max_text_tokens: int) -> None:
        self._ponder = ponder
        self._draft = draft
        self._max_text_tokens = max_text_tokens
        self._t_yes = ponder.format.vocabulary.t_yes
        self._ends = ends_of_text(ponder.format.vocabulary)
        self._is_text_V, self._may_end_V = allowed_tokens(ponder, ends=False), allowed_tokens(ponder, ends=True)

    def wants_to_write(self, hidden_1H: Tensor) -> bool:
        """Whether T_yes is the most likely of all next tokens."""
        return int(self._ponder.logits(hidden_1H)[0].argmax()) == self._t_yes

    def write(
        self,
        context: Session,
        before: SavedState,
        observation_ids: Sequence[int],
        observation_TH: Tensor,
        *,
        with_reasoning: bool,
        exactly: int | None,
    ) -> Steps[tuple[Text, ...]]:
        """Generates a transition into ``context``, which is at ``before``; DR first if ``with_reasoning``.

        DR ends with the T_yes that opens S, or at its limit, and S follows in both cases; T_no after DR ends the
        transition without S. ``exactly`` forces one text of this many tokens.

        Raises ContextFull if not even one token of each text fits; the caller must restore ``before``.
        """
        num_carriers = self._ponder.format.num_carriers
        t_yes_TH = self._ponder.embed([self._t_yes])
        opened = torch.cat([observation_TH, t_yes_TH])
        hidden_NH = yield Append(session=context, ids=[*observation_ids, self._t_yes], embeds_TH=opened, num_wanted=1)
        texts = []
        if with_reasoning:
            num_kept = 2 + num_carriers  # T_yes and one token of S
            limit = self._limit(context, before, num_kept, None)
            text, end = yield from self._decode(context, hidden_NH, "demo_reasoning", limit, None)
            texts.append(text)
            if end not in (self._t_yes, None):
                return tuple(texts)
            hidden_NH = yield Append(session=context, ids=[self._t_yes], embeds_TH=t_yes_TH)
        limit = self._limit(context, before, num_carriers, exactly)
        text, _ = yield from self._decode(context, hidden_NH, "subgoal", limit, exactly)
        return (*texts, text)

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
        kind: Literal["subgoal", "demo_reasoning"],
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
            before_draft = context.save(context.before_draft) if draft else None
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
        text = Text(
            kind=kind,
            text=self._ponder.format.vocabulary.decode(ids),
            token_ids=tuple(ids),
            truncated=end is None and exactly is None,
        )
        return text, end

    def _append(self, context: Session, ids: Sequence[int], *, num_wanted: int) -> Append:
        return Append(session=context, ids=ids, embeds_TH=self._ponder.embed(ids), num_wanted=num_wanted)

    def _greedy(self, hidden_NH: Tensor, allowed_V: Tensor) -> list[int]:
        """The most likely allowed token after each of N."""
        logits_NV = self._ponder.logits(hidden_NH).masked_fill(~allowed_V, float("-inf"))
        return logits_NV.argmax(dim=-1).tolist()  # type: ignore[no-any-return]
