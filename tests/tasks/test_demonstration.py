"""Demonstrations in general: what is recorded, under which text, and by which clock."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dual_system.tasks import panda
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.reference.pick_highlight import Layout, Memory, PickHighlight
from dual_system.tasks.task import Shown

HOME = np.append(panda.HOME_QPOS, 1.0)


class WithDemonstration(PickHighlight):
    """PickHighlight after a demonstration of 8 + 6 (unrecorded) + 5 steps; it notes the clock of each staging."""

    def __init__(self) -> None:
        self.clock: list[tuple[int, bool]] = []

    def stage(self, physics: Any, layout: Layout, memory: Memory | None, step: int) -> None:
        self.clock.append((step, memory is None))

    def demonstration(self, layout: Layout) -> tuple[Shown, ...]:
        return (
            Shown(text="wait near the cube[ at <>]", grounds=("cube_0",), motion=lambda motions: motions.hold(8)),
            Shown(text="close", motion=lambda motions: motions.close(), is_recorded=False),
            Shown(text="wait again", motion=lambda motions: motions.hold(5)),
        )


@pytest.fixture(scope="module")
def _env() -> Environment:
    return Environment(WithDemonstration(), image_px=32, render=False, max_steps=4)


@pytest.fixture
def env(_env: Environment) -> Environment:
    _env.task.clock.clear()
    return _env


def test_unrecorded_parts_happen_but_are_left_out(env: Environment) -> None:
    first = env.reset(0)
    video = list(env.demonstration())
    assert [frame.step for frame in video] == list(range(13))
    openings_m = [float(frame.state[7]) for frame in video]
    assert min(openings_m[:8]) > 0.039
    assert max(openings_m[8:]) < openings_m[7] - 0.02  # the fingers closed between two frames
    assert first.state[7] < 0.02  # and the last command stays in force


def test_a_frames_text_is_that_of_its_motion(env: Environment) -> None:
    env.reset(0)
    video = list(env.demonstration())
    assert [frame.simple_subgoal for frame in video] == ["wait near the cube"] * 8 + ["wait again"] * 5
    assert video[0].grounded_subgoal.startswith("wait near the cube at <")


def test_the_scenes_clock_runs_through_and_the_step_count_starts_anew(env: Environment) -> None:
    snapshot = env.reset(0)
    assert snapshot.step == 0
    while snapshot.status is Status.ONGOING:
        snapshot = env.step(HOME)
    assert (snapshot.step, snapshot.status) == (4, Status.TIMEOUT)  # the video does not count against the limit
    steps, memoryless = zip(*env.task.clock, strict=True)
    assert list(steps) == list(range(8 + 6 + 5 + 1 + 4))
    assert [step for step, is_new in zip(steps, memoryless, strict=True) if is_new] == [0, 19]


def test_a_task_without_one_has_an_empty_video(pick_highlight: Environment) -> None:
    pick_highlight.reset(0)
    assert list(pick_highlight.demonstration()) == []


@pytest.mark.sim
def test_pictures_of_the_video_are_rendered_when_watched_and_own_their_memory() -> None:
    with Environment(WithDemonstration(), image_px=32, render=True, max_steps=4) as env:
        before = env.reset(0)
        a, b = list(env.demonstration(5))[:2]
        after = env.step(HOME)
        for camera, frame in a.frames.items():
            assert frame.shape == (32, 32, 3)
            assert not np.shares_memory(frame, b.frames[camera])
        assert before.frames.keys() == a.frames.keys() == after.frames.keys()


@pytest.mark.sim
@pytest.mark.parametrize("look_hz", [1, 2, 5, 10])
def test_who_looks_now_and_then_looks_at_the_end(look_hz: int) -> None:
    with Environment(WithDemonstration(), image_px=32, render=True, max_steps=4) as env:
        env.reset(0)
        seen = [bool(snapshot.frames) for snapshot in env.demonstration(look_hz=look_hz)]
        last = len(seen) - 1
        assert last % 20, "it ends between two looks"
        assert [step for step, looked in enumerate(seen) if looked] == sorted({*range(0, last, 20 // look_hz), last})


def test_watching_needs_an_episode() -> None:
    env = Environment(WithDemonstration(), image_px=32, render=False, max_steps=4)
    with pytest.raises(RuntimeError, match="call reset first"):
        env.demonstration()


def test_a_saved_episode_carries_its_video(env: Environment) -> None:
    env.reset(0)
    saved, video = env.save(), [said(frame) for frame in env.demonstration()]
    env.reset(1)
    env.restore(saved)
    assert [said(frame) for frame in env.demonstration()] == video


def said(frame: Snapshot) -> tuple[str, bytes]:
    return frame.grounded_subgoal, frame.state.tobytes()
