"""Fills an empty context with an episode's opening: in a few large forwards, or look by look where notes are taken.

# T tokens, N wanted ones, H hidden
"""

from collections.abc import Callable, Sequence

from torch import Tensor

from dual_system.models.eyes import Pictures
from dual_system.models.ponder.context import Segment, SegmentKind, in_groups
from dual_system.models.ponder.network import Ponder
from dual_system.models.views import AS_IT_IS, View
from ponder_server.context_policy import Span
from ponder_server.contract import Note, Opening
from ponder_server.prefixes import Opened, Prefixes
from ponder_server.runner import Append, Session
from ponder_server.writer import Steps, TransitionWriter


class Opener:
    """Encodes openings for one engine."""

    def __init__(
        self,
        ponder: Ponder,
        writer: TransitionWriter,
        embed: Callable[[Sequence[int], Sequence[Pictures]], Tensor],
        *,
        max_prefixes: int,
        chunk_tokens: int,
    ) -> None:
        """``embed``: tokens and the pictures among them, (T, H); the rest as in ``EngineConfig``."""
        self._ponder = ponder
        self._writer = writer
        self._embed = embed
        self._prefixes = Prefixes(max_prefixes)
        self._chunk_tokens = chunk_tokens

    def encode(
        self,
        context: Session,
        opening: Opening,
        segments: Sequence[Segment],
        pictures: Sequence[Pictures],
        view: View = AS_IT_IS,
    ) -> Steps[Opened]:
        """Fills the context and tells what its tokens are; from an equal opening of before, if there was one.

        ``view``: how the pictures were seen; those seen otherwise than they are make no beginning for others.

        Raises ContextFull if notes do not fit; the caller closes the context.
        """
        is_shared = opening.has_demo and view.shows_it_as_it_is
        if is_shared and (found := self._prefixes.find(opening)) is not None:
            context.start_from(found[0])
            return found[1]
        takes_notes = self._ponder.format.takes_notes and self._ponder.format.speaks
        fill = self._look_by_look if takes_notes and opening.has_demo else self._at_once
        opened = yield from fill(context, segments, [*pictures])
        if is_shared:
            self._prefixes.keep(opening, context, opened)
        return opened

    def _at_once(self, context: Session, segments: Sequence[Segment], pictures: list[Pictures]) -> Steps[Opened]:
        for chunk in in_groups(segments, self._chunk_tokens):
            ids = [token for segment in chunk for token in segment.ids]
            num_images = sum(segment.num_images for segment in chunk)
            yield Append(session=context, ids=ids, embeds_TH=self._embed(ids, pictures[:num_images]), num_wanted=0)
            del pictures[:num_images]
        return Opened(spans=tuple(Span(segment.kind, len(segment)) for segment in segments))

    def _look_by_look(self, context: Session, segments: Sequence[Segment], pictures: list[Pictures]) -> Steps[Opened]:
        """Notes belong to the demonstration: no policy forgets them before it."""
        spans: list[Span] = []
        notes: list[Note] = []
        num_looks = 0
        for segment in segments:
            num_before = context.num_tokens
            embeds_TH = self._embed(segment.ids, pictures[: segment.num_images])
            del pictures[: segment.num_images]
            is_look = segment.kind is SegmentKind.DEMO
            hidden_NH = yield Append(session=context, ids=segment.ids, embeds_TH=embeds_TH, num_wanted=int(is_look))
            if is_look and self._writer.wants_to_write(hidden_NH):
                before = context.save(context.before_fire)
                nothing_0H = embeds_TH[:0]
                texts = yield from self._writer.write(
                    context, before, (), nothing_0H, with_reasoning=False, exactly=None
                )
                notes += [Note(instant=num_looks, text=text) for text in texts]
            num_looks += is_look
            spans.append(Span(segment.kind, context.num_tokens - num_before))
        return Opened(spans=tuple(spans), notes=tuple(notes))
