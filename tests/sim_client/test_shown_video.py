"""What of a demonstration the client shows to PONDER."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import numpy as np
import pytest
from sim_client.shown import how_shown

from dual_system.models.ponder.demo_sampling import DemoSampling
from dual_system.tasks.environment import make_environment
from protocol import images
from protocol.errors import TransportError
from sim_client.evaluate import EvalOptions
from sim_client.gateway.options import GatewayOptions
from sim_client.robot import CAMERAS, demonstration
from sim_client.suite import Suite

CODEC = images.wire_codec(is_local=True)


@pytest.mark.sim
@pytest.mark.parametrize("to_its_end", [False, True])
@pytest.mark.parametrize("demo_hz", [1, 2])
def test_so_many_a_second_are_shown_and_the_last_frame_if_asked(demo_hz: int, to_its_end: bool) -> None:
    with make_environment("VideoUnmask", image_px=32) as env:
        env.reset(3)
        every = list(env.demonstration())
        last = len(every) - 1
        assert last % 20, "it ends between two looks"
        rows = [*range(0, len(every), 20 // demo_hz), *([last] if to_its_end else [])]
        shown = demonstration(env, CODEC, DemoSampling(hz=demo_hz, to_its_end=to_its_end))
        assert len(shown) == len(rows)
        for frame, row in zip(shown, rows, strict=True):
            for camera, image in zip(CAMERAS, frame.images, strict=True):
                np.testing.assert_array_equal(images.unpack(image), every[row].frames[camera])


@pytest.mark.sim
@pytest.mark.parametrize("to_its_end", [False, True])
def test_without_a_video_nothing_is_shown(to_its_end: bool) -> None:
    with make_environment("PickHighlight", image_px=32) as env:
        env.reset(3)
        assert demonstration(env, CODEC, DemoSampling(to_its_end=to_its_end)) == ()


@pytest.mark.sim
@pytest.mark.parametrize("video_end", [False, True])
@pytest.mark.parametrize("demo_hz", [1, 2])
def test_an_evaluation_is_shown_as_much_as_it_was_told_to_and_says_so(
    demo_hz: Literal[1, 2], video_end: bool, tmp_path: Path
) -> None:
    evaluation = EvalOptions(out=tmp_path, demo_hz=demo_hz, video_end=video_end)
    assert evaluation.config().get("video_end", False) is video_end
    assert evaluation.config().get("demo_hz", 1) == demo_hz
    suite = SimpleNamespace(_options=evaluation.sim(), _link=SimpleNamespace(bus=SimpleNamespace(is_local=True)))
    with make_environment("VideoUnmask", image_px=32) as env:
        env.reset(3)
        shown = Suite._demonstration(suite, env)  # type: ignore[arg-type]
        wanted = demonstration(env, CODEC, DemoSampling(hz=demo_hz, to_its_end=video_end))
        assert len(shown) == len(wanted)
        last, wanted_last = (images.unpack(frames[-1].images[0]) for frames in (shown, wanted))
        np.testing.assert_array_equal(last, wanted_last)


def test_an_evaluation_shows_what_its_checkpoint_has_learned_from_unless_it_is_told_otherwise(tmp_path: Path) -> None:
    folder = tmp_path / "ponder"
    folder.mkdir()
    (folder / "ponder.json").write_text(json.dumps({"demonstrations": {"hz": 2, "to_its_end": True}}))
    said = EvalOptions(out=tmp_path, ponder_checkpoint=folder)
    assert said.sim().showing == DemoSampling(hz=2, to_its_end=True)
    assert (said.config()["demo_hz"], said.config()["video_end"]) == (2, True)
    told = EvalOptions(out=tmp_path, ponder_checkpoint=folder, demo_hz=1)
    assert told.sim().showing == DemoSampling(hz=1, to_its_end=True)
    assert "demo_hz" not in told.config()


@pytest.mark.parametrize("said", [{}, {"format": "ponderpounce.ponder/8"}], ids=["nothing", "of before"])
def test_a_checkpoint_that_does_not_say_is_shown_what_the_paper_shows(said: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "ponder.json").write_text(json.dumps(said))
    assert how_shown(None, False, tmp_path) == DemoSampling() == how_shown(None, False, None)
    assert how_shown(4, True, tmp_path) == DemoSampling(hz=4, to_its_end=True)


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        ("{", "ponder.json is no JSON"),
        ('{"demonstrations": {"hz": 3, "to_its_end": true}}', "hz must divide 20, came 3"),
        ('{"demonstrations": {"hz": 2}}', r"ponder.json: demonstrations: missing \['to_its_end'\]"),
    ],
)
def test_a_checkpoint_that_says_nonsense_is_refused(said: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "ponder.json").write_text(said)
    for tell in (
        lambda: how_shown(None, False, tmp_path),
        EvalOptions(out=tmp_path, ponder_checkpoint=tmp_path).config,
    ):
        with pytest.raises(TransportError, match=sentence):
            tell()
    with pytest.raises(TransportError, match=sentence):
        GatewayOptions(dialect="openpi", ponder_checkpoint=tmp_path).plan()
