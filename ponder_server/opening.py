"""Encodes an episode's opening into an empty context, in a few large forwards.

# T tokens, H hidden
"""

from collections.abc import Callable, Iterator, Sequence

from torch import Tensor

from dual_system.models.ponder.context import Segment, in_groups
from dual_system.models.ponder.observation import Pictures
from ponder_server.contract import Opening
from ponder_server.prefixes import Prefixes
from ponder_server.runner import Session


class Opener:
    """Encodes openings for one engine; an opening that was encoded before is copied."""

    def __init__(
        self,
        embed: Callable[[Sequence[int], Sequence[Pictures]], Tensor],
        *,
        max_prefixes: int,
        chunk_tokens: int,
    ) -> None:
        """``embed`` maps tokens and their pictures to (T, H); the other arguments are ``EngineConfig``'s."""
        self._embed = embed
        self._prefixes = Prefixes(max_prefixes)
        self._chunk_tokens = chunk_tokens

    def encode(
        self,
        context: Session,
        opening: Opening,
        segments: Sequence[Segment],
        pictures: Sequence[Pictures],
    ) -> Iterator[None]:
        """Appends ``segments`` with their ``pictures``, one forward an item: other sessions may have one in between.

        If a forward raises, the caller must close the context.
        """
        if opening.has_demo and (found := self._prefixes.find(opening)) is not None:
            context.start_from(found)
            return
        first = 0
        for chunk in in_groups(segments, self._chunk_tokens):
            ids = [token for segment in chunk for token in segment.ids]
            num_images = sum(segment.num_images for segment in chunk)
            context.append(ids, self._embed(ids, pictures[first : first + num_images]), num_wanted=0)
            first += num_images
            yield
        if opening.has_demo:
            self._prefixes.keep(opening, context)
