"""Eyes: one crop of any camera that has it at a whole multiple is the same picture; everything else is refused."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from dual_system.models.eyes import Eye, check_cameras, readable_sizes, see
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.context import ContextFormat
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.vocabulary import Vocabulary

WORKSPACE = Eye(camera=0, box=(0.375, 0.25, 0.875, 0.75))  # 64 x 64 of 128 px
WRIST = Eye(camera=1)
VOCABULARY = Vocabulary.tiny()


def noise(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def enlarged(picture: np.ndarray, times: int) -> np.ndarray:
    return picture.repeat(times, axis=0).repeat(times, axis=1)


@given(times=st.integers(1, 6), top=st.integers(0, 8), left=st.integers(0, 8), seed=st.integers(0, 99))
def test_a_crop_of_an_enlarged_picture_is_the_crop_of_the_picture(times: int, top: int, left: int, seed: int) -> None:
    picture = noise(16, 16, seed)
    eye = Eye(camera=0, box=(top / 16, left / 16, (top + 8) / 16, (left + 8) / 16))
    expected = picture[top : top + 8, left : left + 8]
    assert np.array_equal(see([enlarged(picture, times)], (eye,), (8, 8))[0], expected)


@given(times=st.integers(2, 6), seed=st.integers(0, 99))
def test_a_mean_is_exact_and_rounds_half_up(times: int, seed: int) -> None:
    picture = noise(4 * times, 4 * times, seed)
    squares = picture.reshape(4, times, 4, times, 3).astype(np.float64)
    expected = np.floor(squares.mean(axis=(1, 3)) + 0.5)  # doubles hold these means well enough to tell a half
    assert np.array_equal(see([picture], (Eye(camera=0),), (4, 4))[0], expected)


def test_the_brightest_picture_at_the_greatest_shrink_stays_white() -> None:
    white = np.full((64, 64, 3), 255, np.uint8)
    assert (see([white], (Eye(camera=0),), (4, 4)) == 255).all()


@given(num=st.integers(1, 3), eyes=st.sampled_from([None, (WORKSPACE,), (WORKSPACE, WRIST)]))
def test_what_was_seen_is_seen_again_unchanged(num: int, eyes: tuple[Eye, ...] | None) -> None:
    assume(eyes is None or num > max(eye.camera for eye in eyes))
    px = (128, 128) if eyes is None or WRIST in eyes else (64, 64)
    side = 256 if WRIST in (eyes or ()) else 128
    once = see([noise(side, side, seed) for seed in range(num)], eyes, px)
    assert once.dtype == np.uint8
    assert np.array_equal(see(list(once), None, px), once)


edges = st.lists(st.integers(0, 20), min_size=2, max_size=2, unique=True).map(sorted)


@given(
    rows=edges,
    columns=edges,
    camera=st.integers(0, 1),
    px=st.sampled_from([(4, 4), (4, 8), (6, 3)]),
    size=st.tuples(st.integers(1, 80), st.integers(1, 80)),
)
def test_sizes_that_are_named_can_be_seen_and_others_cannot(
    rows: list[int], columns: list[int], camera: int, px: tuple[int, int], size: tuple[int, int]
) -> None:
    (top, bottom), (left, right) = rows, columns
    eyes = (Eye(camera=camera, box=(top / 20, left / 20, bottom / 20, right / 20)),)
    sizes = readable_sizes(eyes, px)
    for good in sizes[:2]:
        assert see([noise(*good)] * 2, eyes, px).shape == (1, *px, 3)
    if size not in sizes:
        with pytest.raises(ValueError, match=f"camera {camera} gives {size[0]} x {size[1]} px pictures"):
            see([noise(*size)] * 2, eyes, px)


def test_half_of_a_picture_needs_one_twice_as_wide() -> None:
    assert readable_sizes((Eye(camera=0, box=(0, 0, 1, 0.5)),), (64, 64))[:2] == [(64, 128), (128, 256)]


def test_eyes_look_in_their_own_order() -> None:
    views = [noise(128, 128, seed) for seed in range(2)]
    wrist, workspace = see(views, (Eye(camera=1, box=(0.5, 0.5, 1.0, 1.0)), WORKSPACE), (64, 64))
    assert np.array_equal(wrist, views[1][64:, 64:])
    assert np.array_equal(workspace, views[0][48:112, 32:96])


@pytest.mark.parametrize(
    ("sizes", "eyes", "said"),
    [
        ([(200, 200)], (WORKSPACE,), "camera 0 gives 200 x 200 px pictures; PONDER reads 128 x 128 or 256 x 256"),
        ([(128, 128), (96, 96)], (WORKSPACE, WRIST), "camera 1 gives 96 x 96 px"),
        ([(128, 128)], (WRIST,), "looks through camera 1, counted from 0; there are 1"),
        ([(64, 64), (128, 128)], None, "camera 1 gives 128 x 128 px pictures; PONDER reads 64 x 64 px"),
    ],
)
def test_cameras_that_cannot_be_read_are_refused_with_sizes_that_can(
    sizes: list[tuple[int, int]], eyes: tuple[Eye, ...] | None, said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        check_cameras(sizes, eyes, (64, 64))


def test_a_camera_that_no_eye_uses_may_have_any_size() -> None:
    check_cameras([(128, 128), (17, 5)], (WORKSPACE,), (64, 64))


@pytest.mark.parametrize(
    ("eyes", "said"),
    [
        ((), "at least one"),
        ((Eye(camera=0), Eye(camera=0, box=(0, 0, 1 / 64, 1 / 64))), "no size of camera suits"),
    ],
)
def test_eyes_that_no_camera_suits_are_refused(eyes: tuple[Eye, ...], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        replace(tiny_cpu(), image_px=(64, 64), eyes=eyes)


@pytest.mark.parametrize(
    ("camera", "box"), [(-1, (0, 0, 1, 1)), (0, (0, 0, 1)), (0, (0.5, 0, 0.5, 1)), (0, (0, 0, 1, 1.1))]
)
def test_an_eye_without_a_place_is_refused(camera: int, box: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="eye: "):
        Eye(camera=camera, box=box)


def test_a_view_that_is_no_picture_is_named() -> None:
    with pytest.raises(ValueError, match=re.escape("frame 1: float32 of shape (64, 64, 3); expected uint8 (height")):
        see([noise(64, 64), np.zeros((64, 64, 3), np.float32)], (Eye(camera=0),), (64, 64))


@given(num_views=st.integers(1, 3), eyes=st.sampled_from([None, (WORKSPACE,), (WRIST, WORKSPACE)]))
def test_the_row_has_an_image_per_eye_or_without_eyes_one_per_view(
    num_views: int, eyes: tuple[Eye, ...] | None
) -> None:
    form = ContextFormat(
        vocabulary=VOCABULARY, num_carriers=1, first_carrier_id=440, image_grid=(2, 2), token_px=32, eyes=eyes
    )
    expected = num_views if eyes is None else len(eyes)
    for segment in (form.demo(num_views), form.observation(num_views)):
        assert segment.num_images == segment.ids.count(VOCABULARY.vision_start) == expected
        assert segment.ids.count(VOCABULARY.image_pad) == 4 * expected


@pytest.mark.parametrize(("patch_px", "grid"), [(8, (4, 4)), (16, (2, 2))])
def test_the_patch_size_decides_how_many_tokens_a_picture_is(patch_px: int, grid: tuple[int, int]) -> None:
    config = replace(
        tiny_cpu(),
        num_layers=4,
        image_px=(64, 64),
        vision_patch_px=patch_px,
        vision_num_positions=64,
        eyes=(WORKSPACE,),
    )
    ponder = Ponder.random(config, VOCABULARY, seed=1)
    assert (ponder.format.image_grid, ponder.format.image_px, ponder.format.token_px) == (grid, (64, 64), 2 * patch_px)
    pictures = torch.from_numpy(see([noise(128, 128), noise(128, 128)], config.eyes, config.image_px))
    row = ponder.format.row([*ponder.format.opening("press"), *ponder.format.query(2)])
    with torch.no_grad():
        assert ponder.image_features(pictures).shape == (grid[0] * grid[1], ponder.hidden_size)
        hidden = ponder.encode_row(row, pictures)
        brighter = ponder.encode_row(row, 255 - pictures)
    assert not torch.allclose(hidden[-1], brighter[-1])
