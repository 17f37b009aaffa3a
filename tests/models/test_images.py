"""Laws of the pictures: range, ratio, black borders, and the public resize within one grey level."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from dual_system.models.images import PADDING, camera_batch, resize_with_pad
from dual_system.models.resize import resized_views, weights_of

SIZE_PX = 56


def _frame(height_px: int, width_px: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height_px, width_px, 3), dtype=np.uint8)


@settings(max_examples=30, deadline=None)
@given(height_px=st.integers(1, 200), width_px=st.integers(1, 200))
def test_any_frame_becomes_a_square_in_range(height_px: int, width_px: int) -> None:
    image = resize_with_pad(_frame(height_px, width_px), SIZE_PX)
    assert image.shape == (3, SIZE_PX, SIZE_PX)
    assert image.dtype == torch.float32
    assert image.min() >= -1.0
    assert image.max() <= 1.0


@pytest.mark.parametrize(("height_px", "width_px"), [(100, 200), (200, 100)])
def test_ratio_is_kept_and_the_rest_is_black(height_px: int, width_px: int) -> None:
    white = np.full((height_px, width_px, 3), 255, dtype=np.uint8)
    image = resize_with_pad(white, SIZE_PX)
    if height_px > width_px:
        image = image.transpose(1, 2)
    quarter = SIZE_PX // 4
    assert (image[:, quarter:-quarter] == 1.0).all()
    assert (image[:, :quarter] == PADDING).all()
    assert (image[:, -quarter:] == PADDING).all()


def test_a_frame_of_the_right_size_is_only_scaled() -> None:
    frame = _frame(SIZE_PX, SIZE_PX)
    expected = torch.from_numpy(frame).permute(2, 0, 1).float() / 127.5 - 1.0
    assert torch.equal(resize_with_pad(frame, SIZE_PX), expected)


@pytest.mark.parametrize("side_px", [256, 100, 64])
def test_shrinking_is_pil_bilinear_within_one_level(side_px: int) -> None:
    frame = _frame(side_px, side_px)
    resized = Image.fromarray(frame).resize((SIZE_PX, SIZE_PX), Image.Resampling.BILINEAR)
    ours = (resize_with_pad(frame, SIZE_PX).permute(1, 2, 0).numpy() + 1.0) * 127.5
    assert np.abs(ours - np.asarray(resized)).max() <= 1.001


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 300), st.integers(1, 300), st.integers(1, 120), st.sampled_from([1, 255]), st.integers(0, 2**31))
def test_a_gpu_s_resize_has_the_bits_of_a_cpu_s(
    height_px: int, width_px: int, size_px: int, step: int, seed: int
) -> None:
    """Its own arithmetic, whatever the device: whole numbers in matrices. Noise, and only black and white."""
    frame = _frame(height_px, width_px, seed) // step * step
    expected, _ = camera_batch((frame, None), size_px)
    assert torch.equal(resized_views((frame, None), size_px, torch.device("cpu")), expected)


def test_a_picture_that_shrinks_much_needs_more_bits_than_float32_has() -> None:
    frame = _frame(1, 4000)
    assert weights_of(4000, 14, torch.device("cpu")).matrix.dtype == torch.float64
    assert torch.equal(resized_views((frame,), 14, torch.device("cpu")), camera_batch((frame,), 14)[0])


def test_a_missing_camera_is_black_and_flagged() -> None:
    images, has_view = camera_batch((_frame(64, 64), None), SIZE_PX)
    assert images.shape == (1, 2, 3, SIZE_PX, SIZE_PX)
    assert (images[0, 1] == PADDING).all()
    assert has_view.tolist() == [[True, False]]


def test_read_only_frames_off_the_wire_pass_without_a_warning() -> None:
    frame = np.frombuffer(_frame(64, 64).tobytes(), np.uint8).reshape(64, 64, 3)
    assert resize_with_pad(frame, SIZE_PX).shape == (3, SIZE_PX, SIZE_PX)


def test_strided_frames_are_read_right() -> None:
    frame = _frame(64, 64)
    assert torch.equal(resize_with_pad(frame[:, ::-1], SIZE_PX), resize_with_pad(frame[:, ::-1].copy(), SIZE_PX))
