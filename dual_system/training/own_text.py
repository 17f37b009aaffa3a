"""Rows of a PONDER without memory with the text that it would write itself, in place of the recorded one.

A recorded text may tell what only the past showed, and carriers that stood behind it would copy it into C. So C stands
behind a text that PONDER's newest weights decode greedily from the row's own pictures; the recorded texts are targets
of grounding alone, in rows whose carriers nobody reads.

The text is decoded for all rows in parallel, without a cache: a guess is read, and every token is replaced by the most
likely one after the guess so far, until nothing changes. That fixed point is the greedy text whatever the first guess
was, because its first token depends on no guess, and each further one on those before it. The recorded text is the
first guess and the step has read it anyway; after grounding few passes are left.
"""

# T tokens, H hidden

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from dual_system.models.ponder.context import IGNORE, Row, Segment, SegmentKind
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.text_tokens import allowed_tokens, ends_of_text

MAX_OWN_TOKENS = 64
"""Limit of a text in training; those of the tasks take a dozen tokens, and an untrained PONDER may never end one."""

Read = Callable[[Sequence[Sequence[int]], Sequence[Tensor]], list[Tensor]]
"""Maps rows of tokens and their embeddings (T, H) to final hidden states (T, H)."""


def with_own_texts(
    ponder: Ponder, rows: Sequence[Row], embeds: Sequence[Tensor], hidden: Sequence[Tensor], read: Read
) -> tuple[list[Row], list[Tensor]]:
    """Rows of one query each and their embeddings, with PONDER's own text in place of the recorded one.

    ``embeds`` and ``hidden`` are the given rows'; pictures are not read again.
    """
    form = ponder.format
    begins = [int(row.supervised_index[0]) + 1 for row in rows]
    texts = own_texts(ponder, rows, embeds, hidden, read)
    found = [
        form.row(
            [
                _unsupervised(SegmentKind.OBSERVATION, row.ids[:begin]),
                _unsupervised(SegmentKind.TEXT, () if text is None else (form.vocabulary.t_yes, *text)),
                form.carriers(),
            ]
        )
        for row, begin, text in zip(rows, begins, texts, strict=True)
    ]
    tails = ponder.embed([token for row, begin in zip(found, begins, strict=True) for token in row.ids[begin:]])
    pieces = tails.split([len(row.ids) - begin for row, begin in zip(found, begins, strict=True)])
    joined = [
        torch.cat([embed_TH[:begin], piece]) for embed_TH, begin, piece in zip(embeds, begins, pieces, strict=True)
    ]
    return found, joined


@torch.no_grad()
def own_texts(
    ponder: Ponder, rows: Sequence[Row], embeds: Sequence[Tensor], hidden: Sequence[Tensor], read: Read
) -> list[tuple[int, ...] | None]:
    """The subgoal that serving would decode at each row's query; None where T_yes is not the most likely token."""
    v, ends = ponder.format.vocabulary, ends_of_text(ponder.format.vocabulary, ponder.format.texts)
    is_allowed_V = allowed_tokens(ponder, ends=True)
    begins = [int(row.supervised_index[0]) + 1 for row in rows]
    gates_NV = ponder.logits(torch.stack([each[begin - 1] for each, begin in zip(hidden, begins, strict=True)]))
    opens = (gates_NV.argmax(dim=-1) == v.t_yes).tolist()
    guesses = {
        place: row.ids[begins[place] + 1 : int(row.carrier_index[0, 0])][:MAX_OWN_TOKENS]
        for place, row in enumerate(rows)
        if opens[place]
    }
    # Hidden states after T_yes and after each token of the guess; a row without a recorded text has yet to be read.
    after = {
        place: hidden[place][begins[place] : begins[place] + 1 + len(guess)]
        for place, guess in guesses.items()
        if rows[place].ids[begins[place]] == v.t_yes
    }
    texts: dict[int, tuple[int, ...]] = {}
    while guesses:
        unread = [place for place in guesses if place not in after]
        if unread:
            written = [(v.t_yes, *guesses[place]) for place in unread]
            pieces = ponder.embed([token for ids in written for token in ids]).split([len(ids) for ids in written])
            ids = [(*rows[place].ids[: begins[place]], *tail) for place, tail in zip(unread, written, strict=True)]
            joined = [
                torch.cat([embeds[place][: begins[place]], piece]) for place, piece in zip(unread, pieces, strict=True)
            ]
            for place, hidden_TH in zip(unread, read(ids, joined), strict=True):
                after[place] = hidden_TH[begins[place] :]
        places = list(guesses)
        logits_NV = ponder.logits(torch.cat([after[place] for place in places]))
        predicted = logits_NV.masked_fill(~is_allowed_V, float("-inf")).argmax(dim=-1)
        for place, each in zip(places, predicted.split([len(after.pop(place)) for place in places]), strict=True):
            better: list[int] = each.tolist()
            stop = next((index for index, token in enumerate(better) if token in ends), len(better))
            text = tuple(better[: min(stop, MAX_OWN_TOKENS)])
            if text == guesses[place]:
                texts[place] = text
                del guesses[place]
            else:
                guesses[place] = text
    return [texts.get(place) for place in range(len(rows))]


def _unsupervised(kind: SegmentKind, ids: Sequence[int]) -> Segment:
    return Segment(kind=kind, ids=tuple(ids), targets=(IGNORE,) * len(ids))
