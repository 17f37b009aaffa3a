"""What an engine keeps of an episode beside its tokens, and of a query on its way."""

from __future__ import annotations

from dataclasses import dataclass

from dual_system.models.ponder.observation import Pictures
from ponder_server.context_policy import Span
from ponder_server.runner import Session


@dataclass(slots=True, kw_only=True)
class Episode:
    """A session in use, and what its tokens do not say about it."""

    context: Session
    spans: list[Span]
    """What the cached tokens are."""
    owes_reasoning: bool
    """A demonstration was shown and its reasoning (DR) not yet written; the first transition writes it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Query:
    """A query that was begun."""

    episode: Episode
    pictures: Pictures
    """(images, h, w, 3): what is read of its frames."""
    ids: tuple[int, ...]
    """O_t and the carriers."""
    force_text_tokens: int | None
    turn: int
