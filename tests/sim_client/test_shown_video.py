"""What of a demonstration the client shows to PONDER."""

from __future__ import annotations

import numpy as np
import pytest

from ponderpounce.tasks.environment import make_environment
from protocol import images
from sim_client.robot import CAMERAS, DEMO_HZ, demonstration

CODEC = images.wire_codec(is_local=True)


@pytest.mark.sim
@pytest.mark.parametrize("to_its_end", [False, True])
def test_once_a_second_is_shown_and_the_last_frame_if_asked(to_its_end: bool) -> None:
    with make_environment("VideoUnmask", image_px=32) as env:
        env.reset(3)
        every = list(env.demonstration())
        last = len(every) - 1
        assert last % 20, "it ends between two looks"
        rows = [*range(0, len(every), 20 // DEMO_HZ), *([last] if to_its_end else [])]
        shown = demonstration(env, CODEC, to_its_end=to_its_end)
        assert len(shown) == len(rows)
        for frame, row in zip(shown, rows, strict=True):
            for camera, image in zip(CAMERAS, frame.images, strict=True):
                np.testing.assert_array_equal(images.unpack(image), every[row].frames[camera])


@pytest.mark.sim
@pytest.mark.parametrize("to_its_end", [False, True])
def test_without_a_video_nothing_is_shown(to_its_end: bool) -> None:
    with make_environment("PickHighlight", image_px=32) as env:
        env.reset(3)
        assert demonstration(env, CODEC, to_its_end=to_its_end) == ()
