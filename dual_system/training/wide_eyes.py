"""A PONDER whose eye sees more of the picture, or finer, and what it saw before as it did.

Its box moves or grows by whole tokens and every patch may have more pixels: the weights that read a pixel are shared
out among the ones in its place, and the learned positions are continued to the new patches. What a patch attends to
becomes another, so what it shows changes a little, and what is new is not understood yet: `pp-see --ponder` opens such
eyes. What was seen before stands first in the context and where it stood (``ContextFormat.fovea``): read row by row,
with new tokens between the old ones, the shipped PONDER lost three times as much (docs/training.md, "A fovea").
"""

# C vision width, S side of the square table of positions

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dual_system.models.eyes import Eye
from dual_system.models.ponder.network import Ponder, image_grid, token_px

Box = tuple[float, float, float, float]
"""Top, left, bottom, right as fractions of the camera's picture."""

_ROUNDING = 1e-6


@torch.no_grad()
def wide_eyed(ponder: Ponder, box: Box, zoom: int = 1) -> Ponder:
    """Returns a PONDER whose one eye looks at ``box``, ``zoom`` times as fine.

    Raises ValueError if it has not one eye, or the boxes do not lie apart by whole image tokens.
    """
    eyes = ponder.format.eyes
    if eyes is None or len(eyes) != 1:
        raise ValueError("only a PONDER with one eye can see more with it")
    (eye,) = eyes
    rows, columns = ponder.format.image_grid
    above, left, new_rows, new_columns = _in_tokens(eye.box, box, rows, columns)
    config: Any = copy.deepcopy(ponder.qwen.config)
    vision = config.vision_config
    merge = vision.spatial_merge_size
    side = merge * max(new_rows, new_columns)
    vision.patch_size *= zoom
    vision.num_position_embeddings = side**2
    new_px = token_px(config)
    image_px = (new_rows * new_px, new_columns * new_px)
    first_row, first_column, *sides = ponder.format.fovea or (0, 0, rows, columns)
    fovea = (first_row + above, first_column + left, sides[0], sides[1])
    sees_all = 0 <= above <= new_rows - rows and 0 <= left <= new_columns - columns
    form = replace(
        ponder.format,
        fovea=fovea if sees_all and (new_rows, new_columns) != tuple(sides) else None,
        image_grid=image_grid(config, image_px),
        token_px=new_px,
        eyes=(Eye(camera=eye.camera, box=box),),
    )
    new = ponder.reshaped(config, form=form, image_px=image_px)
    known = ponder.qwen.state_dict()
    for name, value in known.items():
        if name.endswith("patch_embed.proj.weight"):
            known[name] = value.repeat_interleave(zoom, -1).repeat_interleave(zoom, -2) / zoom**2
        elif name.endswith("pos_embed.weight"):
            seen_RCC = _sampled(value.float(), merge * rows, merge * columns)
            for dim, before, count, total in ((0, above, rows, new_rows), (1, left, columns, new_columns)):
                nearest = torch.arange(merge * total) - merge * before
                seen_RCC = seen_RCC.index_select(dim, nearest.clamp(0, merge * count - 1))
            known[name] = _table(seen_RCC, side).to(value)
    new.qwen.load_state_dict(known)
    new.is_random = ponder.is_random
    return new


def _in_tokens(old: Box, new: Box, rows: int, columns: int) -> tuple[int, int, int, int]:
    """How many rows and columns of image tokens come before the old box, and how many there are in the new one.

    Order: rows before, columns before, rows, columns.
    """
    found: list[float] = []
    for before, after, count in ((0, 2, rows), (1, 3, columns)):
        token = (old[after] - old[before]) / count
        found += [(old[before] - new[before]) / token, (new[after] - new[before]) / token]
    above, num_rows, left, num_columns = (round(each) for each in found)
    if any(abs(each - round(each)) > _ROUNDING for each in found):
        raise ValueError(f"box {new} is no whole tokens from {old}, of which each is one of {rows} x {columns}")
    return above, left, num_rows, num_columns


def _sampling(count: int, side: int) -> Tensor:
    """(count, side): what `ponder_vision` samples of a table's side, from corner to corner."""
    if count == side:
        return torch.eye(side, dtype=torch.float64)
    places = torch.linspace(0, side - 1, count, dtype=torch.float64)
    low = places.long().clamp(max=side - 2)
    weights = torch.zeros(count, side, dtype=torch.float64)
    weights[torch.arange(count), low] = 1 - (places - low)
    weights[torch.arange(count), low + 1] = places - low
    return weights


def _sampled(table_PC: Tensor, rows: int, columns: int) -> Tensor:
    """(rows, columns, C) of a square table."""
    side = round(len(table_PC) ** 0.5)
    table_SSC = table_PC.double().unflatten(0, (side, side))
    return torch.einsum("rs,ct,stx->rcx", _sampling(rows, side), _sampling(columns, side), table_SSC)


def _table(seen_RCC: Tensor, side: int) -> Tensor:
    """The smallest square table (side * side, C) that is sampled as these positions, where there is one."""
    down, along = (torch.linalg.pinv(_sampling(count, side)) for count in seen_RCC.shape[:2])
    return torch.einsum("sr,tc,rcx->stx", down, along, seen_RCC.double()).flatten(0, 1).float()
