"""An eye that sees more, or finer, sees what it saw."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dual_system.models.eyes import Eye
from dual_system.models.ponder.configs import small, tiny_cpu
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.vision import _position_embeddings
from dual_system.training.wide_eyes import wide_eyed

PONDER = Ponder.random(small(), seed=1)
(EYE,) = PONDER.format.eyes or ()
WIDE = (40 / 256, 32 / 256, 168 / 256, 224 / 256)


def frames(side_px: int) -> torch.Tensor:
    return torch.randint(0, 256, (2, side_px, side_px, 3), generator=torch.Generator().manual_seed(0)).byte()


@pytest.mark.parametrize("zoom", [1, 2, 4])
def test_of_the_same_view_as_fine_as_one_likes_it_thinks_the_same(zoom: int) -> None:
    fine = wide_eyed(PONDER, EYE.box, zoom)
    assert fine.image_px == fine.format.image_px == (64 * zoom, 64 * zoom)
    pictures = frames(64)
    with torch.no_grad():
        before = PONDER.image_features(pictures)
        after = fine.image_features(pictures.repeat_interleave(zoom, 1).repeat_interleave(zoom, 2))
    torch.testing.assert_close(after, before, rtol=1e-4, atol=1e-4)


def test_a_wide_one_knows_where_every_old_patch_is() -> None:
    wide = wide_eyed(PONDER, WIDE, 2)
    assert (wide.format.image_grid, wide.image_px, wide.format.token_px) == ((4, 6), (128, 192), 32)
    assert wide.format.eyes == (Eye(camera=0, box=WIDE),)
    old = _position_embeddings(PONDER.qwen.model.visual, 8, 8, 2).view(4, 4, 4, -1)
    new = _position_embeddings(wide.qwen.model.visual, 8, 12, 2).view(4, 6, 4, -1)
    # a token further down and to the right: the view begins 32 px lower, and 32 px further left
    torch.testing.assert_close(new[:3, 1:5], old[1:], rtol=1e-4, atol=1e-4)


def test_what_was_seen_before_comes_first() -> None:
    whole = (8 / 256, 32 / 256, 168 / 256, 224 / 256)
    wide = wide_eyed(PONDER, whole)
    assert (wide.format.image_grid, wide.format.fovea) == ((5, 6), (0, 1, 4, 4))
    pictures = torch.randint(0, 256, (2, 80, 96, 3), generator=torch.Generator().manual_seed(0)).byte()
    seen_NSH = wide.image_features(pictures).unflatten(0, (2, 30))
    by_row = replace(wide.format, fovea=None)
    wide.format = by_row
    grid_NRCH = wide.image_features(pictures).view(2, 5, 6, -1)
    torch.testing.assert_close(seen_NSH[:, :16].unflatten(1, (4, 4)), grid_NRCH[:, :4, 1:5], rtol=0, atol=0)
    assert wide_eyed(PONDER, WIDE).format.fovea is None, "a part of what was seen is out of sight"
    assert wide_eyed(PONDER, EYE.box, 2).format.fovea is None, "nothing is new"
    wider = wide_eyed(wide_eyed(PONDER, whole), (8 / 256, 0, 168 / 256, 1.0))
    assert (wider.format.image_grid, wider.format.fovea) == ((5, 8), (0, 2, 4, 4))


def test_all_else_stays() -> None:
    wide, before = wide_eyed(PONDER, WIDE, 2).qwen.state_dict(), PONDER.qwen.state_dict()
    other = {
        name for name in before if wide[name].shape != before[name].shape or not torch.equal(wide[name], before[name])
    }
    assert {name.split(".visual.")[1] for name in other} == {"patch_embed.proj.weight", "pos_embed.weight"}


def test_boxes_between_tokens_are_refused() -> None:
    with pytest.raises(ValueError, match="whole tokens"):
        wide_eyed(PONDER, (24 / 256, 32 / 256, 152 / 256, 224 / 256))
    with pytest.raises(ValueError, match="one eye"):
        wide_eyed(Ponder.random(replace(tiny_cpu(), num_layers=4), seed=0), WIDE)
