"""Where a pointer should point: the patches of the places that a text names, in training only.

A place of the front picture is a point of the table, and the arm's joints say where the wrist camera has it.

In a demonstration the hand is mostly on its way already, and a scene that was seen often is known. A pointer that is
taught the recorded texts alone learns these cues instead of the text. So it also gets lessons: invocations that are
told other places, which nothing but the text gives away.
"""

# I invocations of all examples, Q places of a pointer, P with those of the wrist camera

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dual_system.models.arm import NUM_ARM_JOINTS, Array, Poses, tool_poses
from dual_system.models.cameras import at_height, in_wrist_picture
from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.ponder.context import IGNORE
from dual_system.models.ponder.coordinates import TEXT_PX, XY_1000, xy_1000_from_yx_px
from dual_system.models.windows import WHOLE, Box, placed_in
from dual_system.training.example import Example

_EVERY = 4
"""Number of invocations to each lesson."""
_HEIGHTS_M = {"container": 0.05, "button": 0.01}
_CUBE_M = 0.025  # height above the table of what a cube shows, like those above; of all that is not named there


def pointed_places(examples: Sequence[Example], config: PounceConfig) -> Tensor:
    """The patches of the first places in the newest text before each invocation, in the order of `Pointed.scores`.

    (I, P) int64: patches row by row; `IGNORE` where the text names fewer places, or one outside of the front camera's
    window.
    """
    return torch.cat([_taught(_newest_texts(example), config, example) for example in examples])


def lessons_of(example: Example, config: PounceConfig, rng: np.random.Generator) -> Example:
    """Some invocations of an example, each told its newest text with other places, anywhere in the front window."""
    # An example without invocations has no lessons; any other has one at least, as every part of a batch needs.
    some = slice(int(rng.integers(min(_EVERY, max(1, len(example.invocations))))), None, _EVERY)
    top, left, bottom, right = (int(edge * TEXT_PX) for edge in _window(config, 0))

    def other_place(_: re.Match[str]) -> str:
        yx_px = int(rng.integers(top + 1, bottom)), int(rng.integers(left + 1, right))  # only whole pixels have a token
        return "[{}, {}]".format(*xy_1000_from_yx_px(yx_px))

    told = tuple(XY_1000.sub(other_place, text) for text in _newest_texts(example)[some])
    return replace(example, invocations=example.invocations[some], told=told)


def told_places(lessons: Sequence[Example], config: PounceConfig) -> Tensor:
    """The patches of the places that each invocation is told, as `pointed_places`: those of the front picture alone."""
    return torch.cat([_taught(each.told, config) for each in lessons])


def _newest_texts(example: Example) -> list[str]:
    queries = [each.reference.query for each in example.invocations]
    return ["" if query is None else example.written[query] for query in queries]


def _taught(texts: Sequence[str], config: PounceConfig, seen_in: Example | None = None) -> Tensor:
    """Patches (I, P) of the places in each text; the wrist camera's are ignored unless the texts are ``seen_in`` an
    example's invocations."""
    named_IQ2, side = _named(texts, config.num_pointed), round(config.pi05.vision.num_patches**0.5)
    front_IQ = _patches(placed_in(_window(config, 0), named_IQ2), side, IGNORE)
    if config.num_cameras < 2:
        return torch.from_numpy(front_IQ)
    wrist_IQ = np.full_like(front_IQ, IGNORE)
    if seen_in is not None:
        heights_m = [next((high for name, high in _HEIGHTS_M.items() if name in text), _CUBE_M) for text in texts]
        points_IQ3 = at_height(named_IQ2[..., ::-1], np.array(heights_m)[:, None])
        seen_IQ2 = in_wrist_picture(points_IQ3, _tool(seen_in))
        found_IQ = _patches(placed_in(_window(config, 1), seen_IQ2), side, side**2)
        wrist_IQ = np.where(front_IQ == IGNORE, IGNORE, found_IQ)
    return torch.from_numpy(np.concatenate([front_IQ, wrist_IQ], axis=1))


def _named(texts: Sequence[str], num_places: int) -> Array:
    """Row and column (I, Q, 2) of the first places in each text, as fractions of the picture; NaN for those missing."""
    named_IQ2 = np.full((len(texts), num_places, 2), np.nan)
    for named_Q2, text in zip(named_IQ2, texts, strict=True):
        for place_2, match in zip(named_Q2, XY_1000.finditer(text), strict=False):
            place_2[:] = int(match[2]) / 1000, int(match[1]) / 1000
    return named_IQ2


def _patches(placed_IQ2: Array, side: int, otherwise: int) -> NDArray[np.int64]:
    """The patch that each place (..., 2) of a window lies in; ``otherwise`` outside of it and for NaN."""
    cells_IQ2 = np.floor(placed_IQ2 * side)
    is_inside_IQ: NDArray[np.bool_] = np.all((cells_IQ2 >= 0) & (cells_IQ2 < side), axis=-1)
    inside_IQ2 = np.where(is_inside_IQ[..., None], cells_IQ2, 0).astype(np.int64)
    return np.where(is_inside_IQ, inside_IQ2 @ [side, 1], otherwise)


def _tool(example: Example) -> Poses:
    """The tool's poses (I, 1) when the pictures of the invocations were taken."""
    episode, ticks = example.episode, [each.tick for each in example.invocations]
    taken = ticks if episode.seen_at_T is None else episode.seen_at_T[ticks]
    tool = tool_poses(episode.state_TS[taken, :NUM_ARM_JOINTS])
    return Poses(tool.position_m[:, None], tool.rotation[:, None])


def _window(config: PounceConfig, camera: int) -> Box:
    return config.windows[camera] if config.windows else WHOLE
