"""What stands in for a tower's pretraining: at every place of a picture, which thing is centred there, and where it is.

A linear head on the tower's tokens predicts, for each cell of a token's square, the kind of thing, the offset to its
centre, its position and its yaw. Only the tower is kept. Positions are in the table's frame for the front camera and
in the tool's for the wrist camera, so that a controller finds in its tokens what it has to reach.
"""

# B pictures, S tokens, W tower width, G cells along a side, K labelled things (padded), C kinds

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dual_system.policy.studio import NAMES, Still

CELL_PX = 4
"""Side of a cell: of two cubes of 7 px neither hides the other in its cell."""
_NUM_OUT = len(NAMES) + 2 + 3 + 2  # kinds, offset, position, cosine and sine
_NEAR_CELLS = 1.0
_DM = 10.0  # positions are learned in decimetres
_TURNS = np.array([4, 4, 4, 4, 4, 0, 0, 2])  # a cube looks alike after a quarter turn, a peg after half a turn
_POSITIVE_WEIGHT, _KIND_WEIGHT, _YAW_WEIGHT = 4.0, 8.0, 0.5


class LocatingHead(nn.Module):
    """(B, S, W) -> (B, _NUM_OUT, G, G); a token covers ``token_px`` x ``token_px`` pixels."""

    def __init__(self, width: int, token_px: int) -> None:
        super().__init__()
        self._cells = token_px // CELL_PX
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, _NUM_OUT * self._cells**2)

    def forward(self, tokens_BSW: Tensor) -> Tensor:
        out = self.out(self.norm(tokens_BSW)).transpose(1, 2)
        side = round(out.shape[-1] ** 0.5)
        return F.pixel_shuffle(out.unflatten(-1, (side, side)), self._cells)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Labels:
    """Things in B pictures of one camera, padded to K."""

    place_BK2: Tensor
    """Row and column as fractions of the window."""
    kind_BK: Tensor
    """int64"""
    is_real_BK: Tensor
    position_BK3: Tensor
    """In metres, in the frame of `locating`."""
    turn_BK2: Tensor
    """Cosine and sine of the yaw, times the thing's symmetry; zero for round things."""

    def __getitem__(self, index: Tensor) -> Labels:
        return Labels(
            place_BK2=self.place_BK2[index],
            kind_BK=self.kind_BK[index],
            is_real_BK=self.is_real_BK[index],
            position_BK3=self.position_BK3[index],
            turn_BK2=self.turn_BK2[index],
        )


def labels_of(stills: Sequence[Still], camera: str) -> Labels:
    """Labels of a camera's pictures, in the tool's frame for the wrist camera."""
    most = max(1, max(len(still.things) for still in stills))
    shape = (len(stills), most)
    place, position, turn = np.zeros((*shape, 2)), np.zeros((*shape, 3)), np.zeros((*shape, 2))
    kind, is_real = np.zeros(shape, np.int64), np.zeros(shape, bool)
    for row, still in enumerate(stills):
        tool = still.tool if camera == "wrist" else np.eye(4)
        tool_yaw_rad = np.arctan2(tool[1, 1], tool[0, 1]) if camera == "wrist" else 0.0
        seen = [thing for thing in still.things if camera in thing.seen]
        for column, thing in enumerate(seen):
            place[row, column] = thing.seen[camera]
            position[row, column] = tool[:3, :3].T @ (thing.position_m - tool[:3, 3])
            kind[row, column], is_real[row, column] = thing.kind, True
            if times := int(_TURNS[thing.kind]):
                angle = times * (thing.yaw_rad - tool_yaw_rad)
                turn[row, column] = np.cos(angle), np.sin(angle)
    return Labels(
        place_BK2=torch.from_numpy(place).float(),
        kind_BK=torch.from_numpy(kind),
        is_real_BK=torch.from_numpy(is_real),
        position_BK3=torch.from_numpy(position).float(),
        turn_BK2=torch.from_numpy(turn).float(),
    )


def locating_loss(out_BOGG: Tensor, labels: Labels) -> Tensor:
    """Scalar: cross-entropy of the kinds over all cells, and absolute errors at the cells within one of a centre."""
    side = out_BOGG.shape[-1]
    kinds = len(NAMES)
    kind_BCGG, offset_B2GG, position_B3GG, turn_B2GG = out_BOGG.split([kinds, 2, 3, 2], dim=1)
    away_BK2GG = labels.place_BK2[..., None, None] * side - _centers(side)
    near_BKGG = (away_BK2GG.square().sum(2) < _NEAR_CELLS**2) & labels.is_real_BK[..., None, None]
    of_kind = F.one_hot(labels.kind_BK, kinds).bool()
    wanted_BCGG = (near_BKGG[:, :, None] & of_kind[..., None, None]).any(1).float()
    weight = torch.tensor(_POSITIVE_WEIGHT)
    loss = _KIND_WEIGHT * F.binary_cross_entropy_with_logits(kind_BCGG, wanted_BCGG, pos_weight=weight)
    near = near_BKGG.float()
    count = near.sum().clamp(min=1)
    loss = loss + ((offset_B2GG[:, None] - away_BK2GG).abs().sum(2) * near).sum() / count
    wanted = labels.position_BK3[..., None, None] * _DM
    loss = loss + ((position_B3GG[:, None] - wanted).abs().sum(2) * near).sum() / count
    turning = near * labels.turn_BK2.any(-1)[..., None, None]
    error = (turn_B2GG[:, None] - labels.turn_BK2[..., None, None]).abs().sum(2)
    return loss + _YAW_WEIGHT * (error * turning).sum() / turning.sum().clamp(min=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Located:
    """How well things of held-out pictures are found."""

    missed: float
    """Share of things for which no peak of their kind lies within a cell."""
    px: float
    """Median distance from the centre, in pixels of the window."""
    mm: float
    """Median distance of the position."""
    mm_p90: float

    def __str__(self) -> str:
        return f"missed {self.missed:.3f}, {self.px:.2f} px, {self.mm:.1f} mm (p90 {self.mm_p90:.1f})"


def located(out_BOGG: Tensor, labels: Labels, image_px: int) -> Located:
    """Reads peaks of each kind's map and compares them with the labels."""
    side, kinds = out_BOGG.shape[-1], len(NAMES)
    chance = out_BOGG[:, :kinds].sigmoid()
    is_peak = (chance == F.max_pool2d(chance, 3, 1, 1)) & (chance > 0.5)
    errors_px, errors_mm, missed, total = [], [], 0, 0
    for b, k in labels.is_real_BK.nonzero().tolist():
        total += 1
        rows, columns = is_peak[b, labels.kind_BK[b, k]].nonzero(as_tuple=True)
        found = out_BOGG[b, kinds : kinds + 2, rows, columns].T + torch.stack([rows + 0.5, columns + 0.5], dim=1)
        distance = (found - labels.place_BK2[b, k] * side).norm(dim=1)
        if len(distance) == 0 or distance.min() > _NEAR_CELLS:
            missed += 1
            continue
        best = int(distance.argmin())
        position = out_BOGG[b, kinds + 2 : kinds + 5, rows[best], columns[best]] / _DM
        errors_px.append(float(distance[best]) * image_px / side)
        errors_mm.append(1e3 * float((position - labels.position_BK3[b, k]).norm()))
    if not errors_mm:
        return Located(missed=1.0, px=float("nan"), mm=float("nan"), mm_p90=float("nan"))
    return Located(
        missed=missed / max(total, 1),
        px=float(np.median(errors_px)),
        mm=float(np.median(errors_mm)),
        mm_p90=float(np.quantile(errors_mm, 0.9)),
    )


def _centers(side: int) -> Tensor:
    """(2, G, G): row and column of every cell's centre, in cells."""
    middle = torch.arange(side) + 0.5
    return torch.stack(torch.meshgrid(middle, middle, indexing="ij"))
