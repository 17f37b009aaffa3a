"""Embeddings of places for networks from scratch: near places begin with near rows, as pretraining would leave them.

Drawn apart, the 514 words of `PLACE_WORDS` have to be learned one by one, and a few hundred episodes name few places.
"""

# V tokens, W width, P pixels of a picture's side and its far edge, F features of a place

import torch
from torch import Tensor

_WAVES = 12
"""Half waves over the picture of the finest feature: places a patch of the laptop pair apart (18 of 256 px) still have
rows that are more alike than not, places 64 px apart have not."""


@torch.no_grad()
def draw_place_words(table_VW: Tensor, ids: list[int], generator: torch.Generator) -> None:
    """Draws the rows of `PLACE_WORDS` anew, in place, with the table's own rms: random sums of waves over the picture.

    Args:
        table_VW: embeddings of a tokenizer's ids.
        ids: those of `coordinates.PLACE_WORDS`, in its order: first all x, then all y.
        generator: of the CPU.
    """
    rms = float(table_VW.square().mean().sqrt())
    ids_2P = torch.tensor(ids).view(2, -1)
    features_PF = _waves(ids_2P.shape[1])
    for of_axis in ids_2P:
        drawn_PW = features_PF @ torch.randn(features_PF.shape[1], table_VW.shape[1], generator=generator)
        table_VW[of_axis] = (drawn_PW * (rms / drawn_PW.square().mean().sqrt())).to(table_VW)


def _waves(count: int) -> Tensor:
    """Features of places along one axis: the place, and waves whose power falls with their number."""
    place_P = torch.linspace(0, 1, count)
    wave_F = torch.arange(1, _WAVES + 1)
    phase_PF = torch.pi * place_P[:, None] * wave_F
    return torch.cat([4 * place_P[:, None] - 2, phase_PF.cos() / wave_F.sqrt(), phase_PF.sin() / wave_F.sqrt()], dim=-1)
