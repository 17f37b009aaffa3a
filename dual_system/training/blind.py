"""Rows of words alone: notes of a demonstrated way, and what follows from them, without a picture.

Whoever has watched a few hundred ways can tell the plan of one from its pictures and need not look at the notes. Then
the plan has errors of its own, beside those of the notes. In a row without pictures, of places that were never seen,
there are only the notes to look at, and it is a third as long.
"""

# T tokens

from __future__ import annotations

from dataclasses import replace
from itertools import compress

import numpy as np

from dual_system.models.ponder.context import IGNORE, Row
from dual_system.models.ponder.vocabulary import Vocabulary


def without_pictures(row: Row, vocabulary: Vocabulary) -> Row:
    """The row without its image tokens; those that begin and end a picture stay, and stand for the look.

    Nothing before the first query is learned, nor whether there is a note: that is to be seen.
    """
    targets = (*(IGNORE,) * row.gate_index[0], *row.targets[row.gate_index[0] :])
    is_kept_T = np.asarray(row.ids) != vocabulary.image_pad
    place_T = np.cumsum(is_kept_T) - 1  # of those that stay
    return replace(
        row,
        ids=tuple(compress(row.ids, is_kept_T)),
        targets=tuple(compress(targets, is_kept_T)),
        carrier_index=place_T[row.carrier_index],
        gate_index=place_T[row.gate_index],
        num_images=0,
        num_shown=int(is_kept_T[: row.num_shown].sum()),
    )
