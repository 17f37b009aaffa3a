"""Where a pointer should point: the patches of the places that a text names, in training only.

In a demonstration the hand is mostly on its way already, and a scene that was seen often is known. A pointer that is
taught the recorded texts alone learns these cues instead of the text. So it also gets lessons: invocations that are
told other places, which nothing but the text gives away.
"""

# I invocations of all examples, Q places of a pointer

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.ponder.context import IGNORE
from dual_system.models.ponder.coordinates import TEXT_PX, XY_1000, xy_1000_from_yx_px
from dual_system.models.windows import WHOLE, Box, placed_in
from dual_system.training.example import Example

_EVERY = 4
"""Number of invocations to each lesson."""


def pointed_places(examples: Sequence[Example], config: PounceConfig) -> Tensor:
    """The patches of the front picture, row by row, of the first places in the newest text before each invocation.

    (I, Q) int64; `IGNORE` where the text names fewer places, or one outside of the front camera's window.
    """
    return _patches_of((text for example in examples for text in _newest_texts(example)), config)


def lessons_of(example: Example, config: PounceConfig, rng: np.random.Generator) -> Example:
    """Some invocations of an example, each told its newest text with other places, anywhere in the front window."""
    # An example without invocations has no lessons; any other has one at least, as every part of a batch needs.
    some = slice(int(rng.integers(min(_EVERY, max(1, len(example.invocations))))), None, _EVERY)
    top, left, bottom, right = (int(edge * TEXT_PX) for edge in _window(config))

    def other_place(_: re.Match[str]) -> str:
        yx_px = int(rng.integers(top + 1, bottom)), int(rng.integers(left + 1, right))  # only whole pixels have a token
        return "[{}, {}]".format(*xy_1000_from_yx_px(yx_px))

    told = tuple(XY_1000.sub(other_place, text) for text in _newest_texts(example)[some])
    return replace(example, invocations=example.invocations[some], told=told)


def told_places(lessons: Sequence[Example], config: PounceConfig) -> Tensor:
    """The patches of the places that each invocation is told, as `pointed_places`."""
    return _patches_of((text for each in lessons for text in each.told), config)


def _newest_texts(example: Example) -> list[str]:
    queries = [each.reference.query for each in example.invocations]
    return ["" if query is None else example.written[query] for query in queries]


def _window(config: PounceConfig) -> Box:
    return config.windows[0] if config.windows else WHOLE


def _patches_of(texts: Iterable[str], config: PounceConfig) -> Tensor:
    side = round(config.pi05.vision.num_patches**0.5)
    return torch.tensor([_patches(text, config.num_pointed, _window(config), side) for text in texts])


def _patches(text: str, num_places: int, box: Box, side: int) -> list[int]:
    found = [_patch(int(match[1]) / 1000, int(match[2]) / 1000, box, side) for match in XY_1000.finditer(text)]
    return (found + [IGNORE] * num_places)[:num_places]


def _patch(x: float, y: float, box: Box, side: int) -> int:
    row, column = (int(each // 1) for each in placed_in(box, (y, x)) * side)
    return row * side + column if 0 <= row < side and 0 <= column < side else IGNORE
