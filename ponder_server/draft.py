"""Drafts for speculative decoding: the network verifies many draft tokens in one forward.

Subgoals are sentences from templates with a few varying words, so a trie over example texts predicts most of each
sentence. Drafts only save time: the result is that of greedy decoding, token for token.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Protocol

from torch import Tensor, nn

from dual_system.models.graphs import Capture

MAX_SUFFIX = 8
"""Longest suffix of the text, in tokens, on which a draft token is conditioned."""
MIN_SUFFIX = 2
"""Shortest such suffix, except at the beginning of a text."""
MIN_CONFIDENCE = 0.5
"""Smallest share of examples that agree on a draft token: a wrong one costs an extra forward."""
_BEGINNING = -1


class Draft(Protocol):
    """Proposes tokens. It must be a pure function: a draft decides which tokens share a forward, thus the last bits."""

    parts: Sequence[nn.Module]
    """Modules that a proposal runs in turn, for heartbeats (``heartbeats``)."""

    def capture(self, capture: Capture) -> None:
        """Captures the forwards of proposals, if there are any."""
        return

    def propose(self, written: Sequence[int], max_tokens: int, hidden_TH: Tensor | None = None) -> tuple[int, ...]:
        """At most ``max_tokens`` text tokens, without an end token, that may follow those ``written`` in this text.

        ``hidden_TH``: the network's hidden state before each written token, for drafts that use it.
        """


class NoDraft(Draft):
    """Proposes nothing: plain greedy decoding."""

    parts: Sequence[nn.Module] = ()

    def propose(self, written: Sequence[int], max_tokens: int, hidden_TH: Tensor | None = None) -> tuple[int, ...]:
        return ()


class FirstOf(Draft):
    """Returns the first non-empty proposal of several drafts."""

    def __init__(self, drafts: Sequence[Draft]) -> None:
        self._drafts = drafts
        self.parts: Sequence[nn.Module] = [part for draft in drafts for part in draft.parts]

    def capture(self, capture: Capture) -> None:
        for draft in self._drafts:
            draft.capture(capture)

    def propose(self, written: Sequence[int], max_tokens: int, hidden_TH: Tensor | None = None) -> tuple[int, ...]:
        proposals = (draft.propose(written, max_tokens, hidden_TH) for draft in self._drafts)
        return next((guesses for guesses in proposals if guesses), ())


class TrieDraft(Draft):
    """Proposes the token that most examples have after the same suffix.

    The trie holds every run of up to ``MAX_SUFFIX`` tokens in the examples, so that a text that left its template at a
    number or a colour is recognised again two tokens later.
    """

    parts: Sequence[nn.Module] = ()

    def __init__(self, examples: Iterable[Sequence[int]]) -> None:
        counts: dict[tuple[int, ...], Counter[int]] = {}
        for example in examples:
            tokens = (_BEGINNING, *example)
            for end in range(1, len(tokens)):
                for first in range(max(0, end - MAX_SUFFIX), end):
                    counts.setdefault(tokens[first:end], Counter())[tokens[end]] += 1
        self._next: dict[tuple[int, ...], int] = {}
        for suffix, followers in counts.items():
            token, count = min(followers.items(), key=lambda item: (-item[1], item[0]))
            is_ground = len(suffix) >= MIN_SUFFIX or suffix == (_BEGINNING,)
            if is_ground and count >= MIN_CONFIDENCE * followers.total():
                self._next[suffix] = token

    def propose(self, written: Sequence[int], max_tokens: int, hidden_TH: Tensor | None = None) -> tuple[int, ...]:
        tokens = [_BEGINNING, *written]
        first_guess = len(tokens)
        while len(tokens) < first_guess + max_tokens:
            suffixes = (tuple(tokens[-length:]) for length in range(min(MAX_SUFFIX, len(tokens)), 0, -1))
            token = next((self._next[suffix] for suffix in suffixes if suffix in self._next), None)
            if token is None:
                break
            tokens.append(token)
        return tuple(tokens[first_guess:])
