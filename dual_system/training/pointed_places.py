"""Where a pointer should point: the patches of the places that PONDER's newest text names, in training only."""

# I invocations of all examples, Q places of a pointer

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.ponder.context import IGNORE
from dual_system.models.ponder.coordinates import XY_1000
from dual_system.models.windows import WHOLE, Box, placed_in
from dual_system.training.example import Example


def pointed_places(examples: Sequence[Example], config: PounceConfig) -> Tensor:
    """The patches of the front picture, row by row, of the first places in the newest text before each invocation.

    (I, Q) int64; `IGNORE` where the text names fewer places, or one outside of the front camera's window.
    """
    box = config.windows[0] if config.windows else WHOLE
    side = round(config.pi05.vision.num_patches**0.5)
    texts = [
        "" if each.reference.query is None else example.written[each.reference.query]
        for example in examples
        for each in example.invocations
    ]
    return torch.tensor([_patches(text, config.num_pointed, box, side) for text in texts])


def _patches(text: str, num_places: int, box: Box, side: int) -> list[int]:
    found = [_patch(int(match[1]) / 1000, int(match[2]) / 1000, box, side) for match in XY_1000.finditer(text)]
    return (found + [IGNORE] * num_places)[:num_places]


def _patch(x: float, y: float, box: Box, side: int) -> int:
    row, column = (int(each // 1) for each in placed_in(box, (y, x)) * side)
    return row * side + column if 0 <= row < side and 0 <= column < side else IGNORE
