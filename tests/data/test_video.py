"""Videos: the same frames whichever way they are reached, and the same bytes whenever they are made."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_system.data.video import FRAMES_PER_KEY, VideoJoiner, VideoWriter, read_frames

PX, LENGTHS = 32, (25, 7, 31)


def video(seed: int, num_frames: int) -> bytes:
    """A grey square that wanders over a coloured ground."""
    rng = np.random.default_rng(seed)
    ground = rng.integers(0, 256, (1, 1, 3), np.uint8).repeat(PX, 0).repeat(PX, 1)
    writer = VideoWriter(PX)
    for _ in range(num_frames):
        frame = ground.copy()
        y, x = rng.integers(0, PX - 8, 2)
        frame[y : y + 8, x : x + 8] = 128
        writer.add(frame)
    return writer.finish()


@pytest.fixture(scope="module")
def joined(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[np.ndarray]]:
    """Three videos in one file, and their frames decoded one after the other."""
    folder = tmp_path_factory.mktemp("video")
    joiner = VideoJoiner(folder / "joined.mp4")
    frames: list[np.ndarray] = []
    for seed, length in enumerate(LENGTHS):
        alone = folder / f"{seed}.mp4"
        alone.write_bytes(video(seed, length))
        frames += read_frames(alone, range(length))
        joiner.append(alone.read_bytes())
    joiner.close()
    assert joiner.num_frames == sum(LENGTHS) == len(frames)
    return folder / "joined.mp4", frames


@given(st.sets(st.integers(0, sum(LENGTHS) - 1), min_size=1))
@settings(max_examples=30)
def test_any_frames_of_joined_videos_are_those_of_the_parts(
    joined: tuple[Path, list[np.ndarray]], wanted: set[int]
) -> None:
    path, frames = joined
    for index, frame in zip(sorted(wanted), read_frames(path, sorted(wanted)), strict=True):
        np.testing.assert_array_equal(frame, frames[index])


def test_a_frame_beyond_the_end_is_refused(joined: tuple[Path, list[np.ndarray]]) -> None:
    with pytest.raises(IndexError, match="no frame 63"):
        list(read_frames(joined[0], [sum(LENGTHS)]))


def test_equal_pictures_make_equal_bytes() -> None:
    assert video(3, 2 * FRAMES_PER_KEY) == video(3, 2 * FRAMES_PER_KEY)


def test_what_was_not_looked_at_repeats_the_last_picture(tmp_path: Path) -> None:
    writer = VideoWriter(PX)
    for shade in (40, None, None, 200):
        writer.add(None if shade is None else np.full((PX, PX, 3), shade, np.uint8))
    (tmp_path / "a.mp4").write_bytes(writer.finish())
    means = [frame.mean() for frame in read_frames(tmp_path / "a.mp4", range(4))]
    assert means == pytest.approx([40, 40, 40, 200], abs=3)


def test_the_first_frame_must_be_a_picture() -> None:
    with pytest.raises(ValueError, match="first row"):
        VideoWriter(PX).add(None)
