"""What of a demonstration the client shows to PONDER."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import numpy as np
import pytest

from ponderpounce.tasks.environment import make_environment
from protocol import images
from sim_client.evaluate import EvalOptions
from sim_client.robot import CAMERAS, DEMO_HZ, demonstration
from sim_client.suite import Suite

CODEC = images.wire_codec(is_local=True)


@pytest.mark.sim
@pytest.mark.parametrize("to_its_end", [False, True])
@pytest.mark.parametrize("demo_hz", [DEMO_HZ, 2])
def test_so_many_a_second_are_shown_and_the_last_frame_if_asked(demo_hz: int, to_its_end: bool) -> None:
    with make_environment("VideoUnmask", image_px=32) as env:
        env.reset(3)
        every = list(env.demonstration())
        last = len(every) - 1
        assert last % 20, "it ends between two looks"
        rows = [*range(0, len(every), 20 // demo_hz), *([last] if to_its_end else [])]
        shown = demonstration(env, CODEC, demo_hz=demo_hz, to_its_end=to_its_end)
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


@pytest.mark.sim
@pytest.mark.parametrize("video_end", [False, True])
@pytest.mark.parametrize("demo_hz", [DEMO_HZ, 2])
def test_an_evaluation_is_shown_as_much_as_it_was_told_to_and_says_so(
    demo_hz: Literal[1, 2], video_end: bool, tmp_path: Path
) -> None:
    evaluation = EvalOptions(out=tmp_path, demo_hz=demo_hz, video_end=video_end)
    assert evaluation.config().get("video_end", False) is video_end
    assert evaluation.config().get("demo_hz", DEMO_HZ) == demo_hz
    suite = SimpleNamespace(_options=evaluation.sim(), _link=SimpleNamespace(bus=SimpleNamespace(is_local=True)))
    with make_environment("VideoUnmask", image_px=32) as env:
        env.reset(3)
        shown = Suite._demonstration(suite, env)  # type: ignore[arg-type]
        wanted = demonstration(env, CODEC, demo_hz=demo_hz, to_its_end=video_end)
        assert len(shown) == len(wanted)
        last, wanted_last = (images.unpack(frames[-1].images[0]) for frames in (shown, wanted))
        np.testing.assert_array_equal(last, wanted_last)
