"""Guesses of how a text goes on, for the network to check many tokens in one forward.

Subgoals are sentences from templates with a few varying words, so a trie over example texts guesses most of each
sentence. A guess can only save time: what is written is what greedy decoding writes, token for token.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Protocol

from torch import Tensor, nn

MAX_SUFFIX = 8
"""Tokens of the past that a guess looks at."""
MIN_SUFFIX = 2
"""Less of the past than this is no ground for a guess, but for the beginning of a text."""
MIN_CONFIDENCE = 0.5
"""A guess ends where the examples do not mostly agree: a wrong one costs a forward of its own."""
_BEGINNING = -1


class Draft(Protocol):
    """Must depend on its arguments alone: it decides which tokens share a forward, and with it the last bits."""

    parts: Sequence[nn.Module]
    """Run one after another for a proposal, so that it can be heard (``audible``)."""

    def propose(self, written: Sequence[int], max_tokens: int, hidden_TH: Tensor | None = None) -> tuple[int, ...]:
        """At most ``max_tokens`` tokens that may follow those ``written`` since the text began.

        Tokens of text only, none that ends it. ``hidden_TH``: the network's hidden state before each of those written,
        for a draft that reads it.
        """


class NoDraft:
    """Plain greedy decoding."""

    parts: Sequence[nn.Module] = ()

    def propose(self, written: Sequence[int], max_tokens: int, hidden_TH: Tensor | None = None) -> tuple[int, ...]:
        return ()


class FirstOf:
    """Asks one draft after another until one has a guess."""

    def __init__(self, drafts: Sequence[Draft]) -> None:
        self._drafts = drafts
        self.parts: Sequence[nn.Module] = [part for draft in drafts for part in draft.parts]

    def propose(self, written: Sequence[int], max_tokens: int, hidden_TH: Tensor | None = None) -> tuple[int, ...]:
        proposals = (draft.propose(written, max_tokens, hidden_TH) for draft in self._drafts)
        return next((guesses for guesses in proposals if guesses), ())


class TrieDraft:
    """Goes where most examples went after the same few tokens.

    A trie over every run of up to ``MAX_SUFFIX`` tokens in the examples, so that a text that left its template at a
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
