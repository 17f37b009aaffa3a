"""An engine's state of an episode besides its tokens, and of a query in progress."""

from __future__ import annotations

from dataclasses import dataclass

from dual_system.models.ponder.observation import Pictures
from ponder_server.context_policy import Span
from ponder_server.runner import Session


@dataclass(slots=True, kw_only=True)
class Episode:
    """A session in use, with the state that its tokens do not show."""

    context: Session
    spans: list[Span]
    """Kinds of the cached tokens, in order."""
    owes_reasoning: bool
    """True from a demonstration to the first transition, which generates its reasoning (DR)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Query:
    """A query in progress."""

    episode: Episode
    pictures: Pictures
    """(images, h, w, 3): the network's images of its frames."""
    ids: tuple[int, ...]
    """Tokens of O_t and the carriers."""
    force_text_tokens: int | None
    turn: int
