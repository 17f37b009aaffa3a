"""PONDER is trained and served on the same tokens and the same pixels, whichever way it reads observations."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from clock.sampling import EVALUATION, sample_schedule
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.observation import WHOLE_VIEWS, Pictures
from dual_system.models.small_pair.reading import CropReader
from dual_system.training.episode import TrainingEpisode
from dual_system.training.example import ExampleConfig, episode_row, row_images
from ponder_server.contract import Opening
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from ponder_server.writer import TransitionWriter

CROP = CropReader(camera=1, box=(0.25, 0.5, 0.75, 1.0), first_state_id=460, num_finger_bins=8, num_height_bins=40)
INSTRUCTION, NUM_TICKS, NUM_DEMO = "press the button", 45, 2
Views = tuple[Pictures, ...]


def ponder_with(reader: CropReader | None) -> Ponder:
    ponder = Ponder.random(replace(tiny_cpu(), image_px=(32, 32), num_layers=4, num_carriers=2), seed=1)
    if reader is not None:
        ponder.format = replace(ponder.format, reader=reader)
    return ponder


PAPERS, CROPS = ponder_with(None), ponder_with(CROP)


def recorded(view_px: int) -> tuple[list[Views], list[Views], np.ndarray]:
    """Views of a demonstration and of an episode, and its states."""
    rng = np.random.default_rng(0)

    def views() -> Views:
        return tuple(rng.integers(0, 256, (view_px, view_px, 3), np.uint8) for _ in range(2))

    demo, seen = ([views() for _ in range(count)] for count in (NUM_DEMO, NUM_TICKS))
    return demo, seen, rng.uniform(-1, 1, (NUM_TICKS, 8)).astype(np.float32)


def engine_of(ponder: Ponder, **changes: int) -> QwenEngine:
    return QwenEngine(ponder, EngineConfig(max_context_tokens=400, max_sessions=1, **changes))


@pytest.mark.parametrize(("ponder", "view_px"), [(PAPERS, 32), (CROPS, 64), (CROPS, 128)])
def test_training_and_serving_read_the_same(monkeypatch: pytest.MonkeyPatch, ponder: Ponder, view_px: int) -> None:
    form = ponder.format
    demo, views, state_TS = recorded(view_px)
    episode = TrainingEpisode(
        instruction=INSTRUCTION,
        demo=tuple(tuple(form.reader.images(each, form.image_px)) for each in demo),
        images=[tuple(form.reader.images(each, form.image_px)) for each in views],
        views=[()] * NUM_TICKS,
        state_TS=state_TS,
        action_TA=np.zeros((NUM_TICKS, 8), np.float32),
        subgoals=[""] * NUM_TICKS,
        is_transition_T=np.zeros(NUM_TICKS, np.bool_),
    )
    schedule = sample_schedule(np.random.default_rng(0), EVALUATION, NUM_TICKS)
    row = episode_row(episode, form, schedule, ExampleConfig(clocks=EVALUATION))
    images = row_images(episode, schedule)
    assert images is not None
    with torch.inference_mode():
        hidden = ponder.encode_row(row, images)

    ids: list[int] = []
    pictures: list[torch.Tensor] = []
    embed = Ponder.embed

    def listened(ponder: Ponder, ids_T: list[int], frames_NHW3: torch.Tensor | None = None, *look: Any) -> torch.Tensor:
        ids.extend(ids_T)
        pictures.extend(() if frames_NHW3 is None else frames_NHW3)
        return embed(ponder, ids_T, frames_NHW3, *look)

    engine = engine_of(ponder)
    monkeypatch.setattr(Ponder, "embed", listened)
    monkeypatch.setattr(TransitionWriter, "gate", lambda *_: (False, 0.0))  # the episode has no texts
    engine.open("a", Opening(instruction=INSTRUCTION, demo_frames=tuple(demo)))
    for query, index_K in zip(schedule.queries, row.carrier_index, strict=True):
        fire = engine.fire("a", views[query.tick], proprio=state_TS[query.tick])
        np.testing.assert_allclose(fire.cognition, hidden[index_K].numpy(), atol=1e-4)
    assert tuple(ids) == row.ids
    assert torch.equal(torch.stack(pictures), images)
    assert len(images) == form.reader.num_images(2) * (NUM_DEMO + len(schedule.queries))


def test_the_engine_announces_its_reader_and_warms_up_on_pictures_that_it_can_read() -> None:
    papers, crops = engine_of(PAPERS), engine_of(CROPS)
    assert (papers.spec.reader, crops.spec.reader) == (WHOLE_VIEWS, CROP)
    assert [frame.shape for frame in papers.example_frames()] == [(32, 32, 3)] * 2
    assert [frame.shape for frame in crops.example_frames()] == [(64, 64, 3)] * 2  # half of it is 32 px
    assert len(crops.warm_up()) >= 20


def test_a_query_without_the_state_that_is_read_leaves_no_trace() -> None:
    _, views, state_TS = recorded(64)
    engine, fresh = engine_of(CROPS), engine_of(CROPS)
    for each in (engine, fresh):
        each.open("a", Opening(instruction=INSTRUCTION))
    with pytest.raises(ValueError, match="none came"):
        engine.fire("a", views[0])
    answered, alike = (each.fire("a", views[0], proprio=state_TS[0]) for each in (engine, fresh))
    assert alike.context_tokens == answered.context_tokens
    assert np.array_equal(alike.cognition, answered.cognition)


def test_an_engine_without_the_camera_that_its_ponder_reads_is_refused() -> None:
    with pytest.raises(ValueError, match="camera 1 gives none; PONDER reads 64 x 64 or 128 x 128"):
        engine_of(CROPS, num_cameras=1)


@pytest.mark.parametrize(
    ("ponder", "view_px", "said"),
    [
        (PAPERS, 32, r"observation, frame 1: uint8 of shape \(24, 24, 3\); expected uint8 \(32, 32, 3\)"),
        (CROPS, 64, "observation, camera 1 gives 24 x 24 px .* PONDER reads 64 x 64 or 128 x 128"),
    ],
)
def test_a_frame_of_another_size_leaves_no_trace(ponder: Ponder, view_px: int, said: str) -> None:
    _, views, state_TS = recorded(view_px)
    front, wrist = views[0]
    engine = engine_of(ponder)
    engine.open("a", Opening(instruction=INSTRUCTION))
    with pytest.raises(ValueError, match=said):
        engine.fire("a", (front, wrist[:24, :24]), proprio=state_TS[0])
    assert engine.fire("a", (front, wrist), proprio=state_TS[0]).cognition.shape == (2, ponder.hidden_size)


def test_a_demonstration_without_the_camera_that_is_read_is_refused() -> None:
    demo, _, _ = recorded(64)
    with pytest.raises(ValueError, match="demo instant 1, 1 views came; PONDER reads camera 1"):
        engine_of(CROPS).open("a", Opening(instruction=INSTRUCTION, demo_frames=(demo[0], demo[1][:1])))
