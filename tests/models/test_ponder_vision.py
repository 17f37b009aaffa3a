"""The batched vision tower is transformers' own, called otherwise."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.patches import patchify


def tower(num_positions: int) -> Ponder:
    config = replace(tiny_cpu(), num_layers=4, image_px=(64, 96), vision_num_positions=num_positions)
    return Ponder.random(config, seed=3)


TOWERS = {n: tower(n) for n in (16, 64)}


@given(num_frames=st.integers(1, 5), num_positions=st.sampled_from(sorted(TOWERS)), seed=st.integers(0, 99))
@settings(max_examples=12, deadline=None)
def test_frames_together_are_what_the_library_makes_of_them(num_frames: int, num_positions: int, seed: int) -> None:
    ponder = TOWERS[num_positions]
    generator = torch.Generator().manual_seed(seed)
    frames = torch.randint(0, 256, (num_frames, 64, 96, 3), dtype=torch.uint8, generator=generator)
    visual = ponder.qwen.model.visual
    patches = patchify(frames)
    public = visual(patches, grid_thw=torch.tensor([[1, 4, 6]] * num_frames)).pooler_output
    ours = ponder.image_features(frames)
    torch.testing.assert_close(ours, public, rtol=1e-4, atol=1e-5)
    weights = list(visual.parameters())
    for mine, theirs in zip(
        torch.autograd.grad(ours.square().sum(), weights),
        torch.autograd.grad(public.square().sum(), weights),
        strict=True,
    ):
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-3 * float(theirs.abs().max()))


def test_what_inference_left_behind_does_not_stop_a_gradient() -> None:
    frames = torch.zeros(1, 64, 96, 3, dtype=torch.uint8)
    with torch.inference_mode():
        TOWERS[16].image_features(frames)
    TOWERS[16].image_features(frames).sum().backward()


@pytest.mark.parametrize("num_frames", [1, 3])
def test_a_frame_does_not_see_the_others(num_frames: int) -> None:
    frames = torch.randint(0, 256, (num_frames + 1, 64, 96, 3), dtype=torch.uint8)
    together, alone = TOWERS[64].image_features(frames), TOWERS[64].image_features(frames[:num_frames])
    torch.testing.assert_close(together[: len(alone)], alone, rtol=0, atol=1e-5)
