"""A PONDER with eyes is trained and served on the same tokens and the same pixels, whatever size the cameras have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from clock.sampling import EVALUATION, sample_schedule
from dual_system.models.counsel import Counsel, Otherwise
from dual_system.models.eyes import Eye, see
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from dual_system.models.proprioception import Proprioception
from dual_system.training.example import episode_row, row_frames
from dual_system.training.training_episode import TrainingEpisode
from ponder_server.contract import Opening
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from ponder_server.writer import TransitionWriter

EYES = (Eye(camera=1), Eye(camera=0, box=(0.25, 0.5, 0.75, 1.0)))
PONDER = Ponder.random(
    replace(tiny_cpu(), image_px=(32, 32), num_layers=4, vision_patch_px=8, num_carriers=2, eyes=EYES), seed=1
)
TOLD_PONDER = Ponder.random(
    replace(
        tiny_cpu(),
        image_px=(32, 32),
        num_layers=4,
        vision_patch_px=8,
        eyes=EYES,
        proprioception=Proprioception(first_id=460),
    ),
    seed=2,
)
FRONT_PX, WRIST_PX = 128, 64
INSTRUCTION = "press the button"


def episode(num_ticks: int = 45, num_demo: int = 2) -> TrainingEpisode:
    rng = np.random.default_rng(0)

    def views() -> tuple[np.ndarray, ...]:
        return tuple(rng.integers(0, 256, (px, px, 3), np.uint8) for px in (FRONT_PX, WRIST_PX))

    return TrainingEpisode(
        instruction=INSTRUCTION,
        demo=tuple(views() for _ in range(num_demo)),
        frames=[views() for _ in range(num_ticks)],
        state_T8=rng.uniform(-1, 1, (num_ticks, 8)).astype(np.float32),
        action_T8=np.zeros((num_ticks, 8), np.float32),
        subgoals=[""] * num_ticks,
        is_transition_T=np.zeros(num_ticks, np.bool_),
    )


def engine_of(ponder: Ponder, **changes: int) -> QwenEngine:
    return QwenEngine(ponder, EngineConfig(max_context_tokens=400, max_sessions=1, **changes))


@pytest.mark.parametrize("ponder", [PONDER, TOLD_PONDER], ids=["pictures", "and the robot's state"])
def test_training_and_serving_see_the_same(monkeypatch: pytest.MonkeyPatch, ponder: Ponder) -> None:
    recorded, form = episode(), ponder.format
    schedule = sample_schedule(np.random.default_rng(0), EVALUATION, recorded.num_ticks)
    row, frames = episode_row(recorded, form, schedule), row_frames(recorded, form, schedule)
    ids: list[int] = []
    pictures: list[torch.Tensor] = []
    embed = Ponder.embed

    def listened(ponder: Ponder, ids_T: list[int], frames_NHW3: torch.Tensor | None = None) -> torch.Tensor:
        ids.extend(ids_T)
        pictures.extend(() if frames_NHW3 is None else frames_NHW3)
        return embed(ponder, ids_T, frames_NHW3)

    with torch.inference_mode():
        hidden = ponder.encode_row(row, frames)
    engine = engine_of(ponder)
    monkeypatch.setattr(Ponder, "embed", listened)
    monkeypatch.setattr(TransitionWriter, "wants_to_write", lambda *_: False)  # the episode has no texts
    engine.open("a", Opening(instruction=INSTRUCTION, demo_frames=recorded.demo))
    for query, index_K in zip(schedule.queries, row.carrier_index, strict=True):
        fire = engine.fire("a", recorded.frames[query.tick], proprio=recorded.state_T8[query.tick])
        np.testing.assert_allclose(fire.cognition, hidden[index_K].numpy(), atol=1e-4)
    assert tuple(ids) == row.ids
    assert torch.equal(torch.stack(pictures), frames)
    assert len(frames) == len(EYES) * (2 + len(schedule.queries))


def test_an_episode_that_keeps_only_what_was_seen_is_the_same_row() -> None:
    recorded, form = episode(), PONDER.format
    schedule = sample_schedule(np.random.default_rng(0), EVALUATION, recorded.num_ticks)
    seen = replace(
        recorded,
        demo=tuple(tuple(see(views, form.eyes, form.image_px)) for views in recorded.demo),
        frames=[tuple(see(views, form.eyes, form.image_px)) for views in recorded.frames],
    )
    blind = replace(form, eyes=None)
    assert episode_row(seen, blind, schedule).ids == episode_row(recorded, form, schedule).ids
    assert torch.equal(row_frames(seen, blind, schedule), row_frames(recorded, form, schedule))


def test_the_engine_says_what_it_looks_at_and_warms_up_on_cameras_that_it_can_read() -> None:
    engine = engine_of(PONDER)
    assert (engine.spec.eyes, engine.spec.num_cameras, engine.spec.image_px) == (EYES, 2, (32, 32))
    assert len(engine.warm_up()) >= 20


def test_a_query_without_the_state_that_is_read_is_refused_and_leaves_no_trace() -> None:
    engine, recorded = engine_of(TOLD_PONDER), episode()
    assert engine.spec.reads_proprio
    assert not engine_of(PONDER).spec.reads_proprio
    engine.open("a", Opening(instruction=INSTRUCTION))
    with pytest.raises(ValueError, match="none came"):
        engine.fire("a", recorded.frames[0])
    answered = engine.fire("a", recorded.frames[0], proprio=recorded.state_T8[0])
    again = engine_of(TOLD_PONDER)
    again.open("a", Opening(instruction=INSTRUCTION))
    alike = again.fire("a", recorded.frames[0], proprio=recorded.state_T8[0])
    assert alike.context_tokens == answered.context_tokens
    assert np.array_equal(alike.cognition, answered.cognition)


def test_an_engine_with_fewer_cameras_than_its_eyes_need_is_refused() -> None:
    with pytest.raises(ValueError, match="looks through camera 1, counted from 0; there are 1"):
        engine_of(PONDER, num_cameras=1)


def test_a_frame_of_another_size_leaves_no_trace() -> None:
    engine, recorded = engine_of(PONDER), episode()
    engine.open("a", Opening(instruction=INSTRUCTION))
    front, wrist = recorded.frames[0]
    with pytest.raises(ValueError, match=r"observation, camera 1 gives 48 x 48 px .* PONDER reads 32 x 32 or 64 x 64"):
        engine.fire("a", (front, wrist[:48, :48]))
    assert engine.fire("a", (front, wrist)).cognition.shape == (2, PONDER.hidden_size)


def test_a_demonstration_without_a_camera_that_is_looked_through_is_refused() -> None:
    recorded = episode()
    demo = (recorded.demo[0], recorded.demo[1][:1])
    with pytest.raises(ValueError, match="demo instant 1, 1 views came and an eye looks through camera 1"):
        engine_of(PONDER).open("a", Opening(instruction=INSTRUCTION, demo_frames=demo))


def test_who_takes_counsel_goes_on_learning_from_what_it_saw() -> None:
    """Other views are of cameras' pictures; what its eye made of them once is read as it is."""
    (_, eye) = EYES
    counsel = Counsel(others=(Otherwise(down_px=2, right_px=-1),), near=30)
    form = replace(PONDER.format, eyes=(eye,), counsel=counsel)
    recorded = episode()
    seen = [tuple(see(views, form.eyes, form.image_px)) for views in recorded.frames]
    demo = tuple(tuple(see(views, form.eyes, form.image_px)) for views in recorded.demo)
    kept = replace(recorded, demo=demo, frames=[()] * recorded.num_ticks, sights=seen)
    schedule = sample_schedule(np.random.default_rng(0), EVALUATION, recorded.num_ticks)
    assert episode_row(kept, form, schedule).ids == episode_row(recorded, form, schedule).ids
    assert torch.equal(row_frames(kept, form, schedule), row_frames(recorded, form, schedule))
