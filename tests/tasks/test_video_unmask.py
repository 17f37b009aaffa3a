"""VideoUnmask: the video shows everything, the execution nothing; and every way to lose."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pytest

from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot, make_environment
from dual_system.tasks.oracle import Motions
from dual_system.tasks.permanence.scenes import Hidden, Layout
from dual_system.tasks.permanence.video_unmask import VideoUnmask
from dual_system.tasks.scene import FRONT

Play = Callable[[Environment, Iterable[np.ndarray]], Snapshot]
Until = Callable[[Environment, int], Snapshot]
Hoist = Callable[[Environment, str], Snapshot]


@pytest.fixture
def env(remembering: Callable[[str], Environment]) -> Environment:
    return remembering("VideoUnmask")


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_sampled_scenes_obey_the_rules(difficulty: str) -> None:
    for seed in range(20):
        layout = VideoUnmask().sample(np.random.default_rng(seed), difficulty)
        assert len(layout.containers) in {"easy": {3}, "medium": {5}, "hard": range(6, 16)}[difficulty]
        assert layout.num_picks == (2 if difficulty == "hard" else 1)
        assert layout.buttons_xy_m == ()


def test_the_video_lasts_66_frames_and_shows_the_cubes_in_32(env: Environment) -> None:
    env.reset(1, "medium")
    video = env.save().video
    assert len(video) == 66
    live = env.save()
    for step, row in enumerate(video):
        env.physics.load(row.physics)
        is_covered = np.abs(env.physics.position_m("container_0")).max() < 1
        assert is_covered == (step >= 32)
    env.restore(live)


def test_everything_is_covered_when_execution_begins(env: Environment) -> None:
    first = env.reset(1, "medium")
    for index, spot in enumerate(env.layout.containers):
        np.testing.assert_allclose(env.physics.position_m(f"container_{index}")[:2], spot.xy_m, atol=3e-4)
    assert first.grounded_subgoal.startswith("pick up the container at <")
    assert first.step == 0


def test_lifting_another_container_fails_with_a_reason(env: Environment, play: Play) -> None:
    env.reset(0, "easy")
    snapshot = play(env, Motions(env.physics).pick_container("container_2"))
    assert snapshot.status is Status.FAIL
    asked, other = (env.layout.hidden[i].color for i in (0, 2))
    assert snapshot.reason == f"lifted container_2, which hides the {other} cube, not the {asked} cube"


def test_hard_while_putting_down_another_one_must_stay_where_it_is(
    env: Environment, until_subtask: Until, hoist: Hoist
) -> None:
    env.reset(2, "hard")
    until_subtask(env, 1)
    assert hoist(env, "container_1").status is Status.FAIL


def test_hard_the_second_is_not_any_other(env: Environment, until_subtask: Until, hoist: Hoist) -> None:
    env.reset(2, "hard")
    until_subtask(env, 2)
    assert hoist(env, "container_0").status is Status.FAIL


def test_the_list_and_the_instruction(env: Environment) -> None:
    env.reset(1, "medium")
    color = env.layout.hidden[0].color
    assert [subtask.text for subtask in env.subtasks] == [f"pick up the container[ at <>] that hides the {color} cube"]
    assert env.instruction == f"watch the video carefully, then pick up the container hiding the {color} cube"


@pytest.mark.sim
def test_only_the_video_tells_scenes_apart_that_hide_different_cubes() -> None:
    """The point of the task: what is seen now does not say what is where, what was seen does."""

    def seen(layout: Layout | None) -> tuple[list[np.ndarray], np.ndarray, Layout]:
        first = env.reset(1, "easy", layout=layout)
        return [frame.frames[FRONT] for frame in env.demonstration(1)], first.frames[FRONT], env.layout

    with make_environment("VideoUnmask", image_px=128) as env:
        video, now, layout = seen(None)
        a, b, c = layout.hidden
        swapped = (Hidden(color=b.color, container=a.container), Hidden(color=a.color, container=b.container), c)
        other_video, other_now, _ = seen(
            Layout(containers=layout.containers, hidden=swapped, num_picks=layout.num_picks)
        )
    differs = [bool(np.any(frame != other)) for frame, other in zip(video, other_video, strict=True)]
    assert differs == [True, True, False, False]
    np.testing.assert_array_equal(now, other_now)


@pytest.mark.acceptance
def test_the_oracle_solves_100_seeds_in_upstreams_time(env: Environment, play: Play) -> None:
    steps: dict[str, list[int]] = {difficulty: [] for difficulty in DIFFICULTIES}
    for seed in range(100):
        env.reset(seed)
        snapshot = play(env, env.oracle())
        assert snapshot.status is Status.SUCCESS, (seed, snapshot.reason)
        steps[env.difficulty].append(66 + snapshot.step)
    for difficulty, upstream_mean in {"easy": 180, "medium": 176, "hard": 331}.items():
        assert np.mean(steps[difficulty]) == pytest.approx(upstream_mean, rel=0.12)
