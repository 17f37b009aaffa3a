"""What an engine keeps of an episode beside its tokens, and of a query on its way."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

from dual_system.models.eyes import Pictures
from dual_system.models.views import View
from ponder_server.context_policy import Span
from ponder_server.contract import Note, SessionError, Text
from ponder_server.runner import SavedState, Session
from ponder_server.standing import Standing


@dataclass(slots=True, kw_only=True)
class Episode:
    """A session in use, and what its tokens do not say about it."""

    context: Session
    spans: list[Span]
    """What the cached tokens are."""
    owes_reasoning: bool
    """A demonstration was shown and its reasoning (DR) not yet written; the first transition writes it."""
    notes: tuple[Note, ...]
    """Of the demonstration, not yet told: the first answer tells them."""
    alone: tuple[int, ...]
    """The opening without its demonstration: what a second look begins with."""
    standing: Standing | None
    """None: it never looks again."""
    acts: Any
    """Who reads it from the second query on (`Ponder.readers`)."""
    view: View
    """The way in which all of its pictures are seen."""
    before: Before | None = None
    """Where the last answer began; None once that cannot be taken back."""

    def answered(self, texts: Sequence[Text], spans: Sequence[Span], saved: SavedState, *, looked_again: bool) -> None:
        """A query was, with these texts, which the context now holds as ``spans``; it began at ``saved``."""
        self.before = Before(
            saved=saved,
            num_spans=len(self.spans),
            owes_reasoning=self.owes_reasoning,
            text_model=self.context.text_model,
            notes=self.notes,
            standing=copy(self.standing),
        )
        self.spans += spans
        self.owes_reasoning &= not texts
        self.context.text_model = self.acts
        self.notes = ()
        if self.standing is not None:
            self.standing.answered([(text.text, text.token_ids) for text in texts], looked_again=looked_again)

    def undo(self) -> None:
        """The last answer never was. Raises SessionError if there is none, or its place in the context is gone."""
        before, self.before = self.before, None
        if before is None:
            raise SessionError(f"session {self.context.name!r} has no answer that could be taken back")
        self.context.restore(before.saved)
        del self.spans[before.num_spans :]
        self.context.text_model = before.text_model
        self.owes_reasoning, self.notes, self.standing = before.owes_reasoning, before.notes, before.standing


@dataclass(frozen=True, slots=True, kw_only=True)
class Before:
    """An episode as it was when its last query came."""

    saved: SavedState
    num_spans: int
    owes_reasoning: bool
    text_model: Any
    notes: tuple[Note, ...]
    standing: Standing | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Query:
    """A query that was begun."""

    episode: Episode
    pictures: Pictures
    """(images, h, w, 3): what is seen of its frames."""
    ids: tuple[int, ...]
    """O_t and the carriers."""
    force_text_tokens: int | None
    saying: tuple[str, ...] | None
    """What is to be said, DR before S; None: what PONDER wants to say."""
    turn: int
