"""What every registered task keeps, at every difficulty: a new task is tested before it has a file of its own."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Any

import numpy as np
import pytest

from dual_system.tasks import panda, sight
from dual_system.tasks.difficulty import DIFFICULTIES
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import (
    IMAGE_PX,
    Environment,
    EpisodeState,
    Snapshot,
    make_environment,
)
from dual_system.tasks.scene import CAMERAS, FRONT
from dual_system.tasks.task import TaskError, make_task, task_names

EnvironmentOf = Callable[[str], Environment]
WalkOf = Callable[[str, str], "tuple[Moment, ...]"]
HOME = np.append(panda.HOME_QPOS, 1.0)
SEED = 7

every_task = pytest.mark.parametrize("name", task_names())
every_fourth_task = pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.acceptance] * (name not in task_names()[::4])) for name in task_names()],
)
every_difficulty = pytest.mark.parametrize(
    "difficulty", [pytest.param(each, marks=[pytest.mark.acceptance] * (each != "hard")) for each in DIFFICULTIES]
)


@pytest.fixture(scope="module")
def environment(remembering: EnvironmentOf) -> EnvironmentOf:
    return remembering


def snapshots(env: Environment, seed: int, difficulty: str) -> Iterator[Snapshot]:
    """The oracle's episode, one snapshot per observation."""
    snapshot = env.reset(seed, difficulty)
    yield snapshot
    for action in env.oracle():
        snapshot = env.step(action)
        yield snapshot
        if snapshot.status is not Status.ONGOING:
            return


def facts(snapshot: Snapshot) -> tuple[Any, ...]:
    """Everything a snapshot says, as comparable bytes and values."""
    return (
        snapshot.step,
        snapshot.state.tobytes(),
        snapshot.tcp_pose.tobytes(),
        snapshot.status,
        snapshot.simple_subgoal,
        snapshot.grounded_subgoal,
        snapshot.subtask_index,
    )


def is_inside_outline(env: Environment, body: str, yx_px: tuple[int, int]) -> bool:
    """True if a pixel lies in the picture of the bounding sphere of one of the body's geoms, by upstream's formula."""
    entry = env.physics.model.body(body)
    geoms = range(int(entry.geomadr[0]), int(entry.geomadr[0] + entry.geomnum[0]))
    x, y, z = env.physics.data.geom_xpos[geoms].T
    depth_m = -0.4472 * x - 0.8944 * z + 0.4919
    centers_yx_px = 128 + 128 * np.stack([0.8944 * x - 0.4472 * z - 0.0894, y], axis=1) / depth_m[:, None]
    radii_px = 128 * env.physics.model.geom_rbound[geoms] / depth_m
    return bool(np.any(np.linalg.norm(np.add(yx_px, 0.5) - centers_yx_px, axis=1) <= radii_px + 2))


@dataclasses.dataclass(frozen=True, slots=True)
class Moment:
    """One observation of an oracle's episode, and what of the environment belongs to it."""

    snapshot: Snapshot
    action: np.ndarray
    """What led to it; for the first, to stay at home."""
    num_subtasks: int
    spoken: str
    """Text of the subtask that the snapshot speaks of, with its brackets."""
    groundings: tuple[tuple[float, bool], ...]
    """For each coordinate of a new text: distance [px] to its object as seen, and whether it is in the outline."""
    saved: EpisodeState | None
    """The environment at every tenth step."""


@pytest.fixture(scope="module")
def walk(environment: EnvironmentOf) -> WalkOf:
    """The oracle's episode of SEED, played once for all tests that look at it."""

    @functools.cache
    def moments(name: str, difficulty: str) -> tuple[Moment, ...]:
        env = environment(name)
        found: list[Moment] = []
        text_before, index_before, action = "", 0, HOME
        snapshot = env.reset(SEED, difficulty)
        actions = env.oracle()
        while True:
            is_new = snapshot.grounded_subgoal != text_before and snapshot.status is Status.ONGOING
            subtask = env.subtasks[min(index_before, len(env.subtasks) - 1)]
            points = re.findall(r"<(\d+), (\d+)>", snapshot.grounded_subgoal) if is_new else []
            groundings = [
                (distance_px(env, body, (int(y), int(x))), is_inside_outline(env, body, (int(y), int(x))))
                for body, (y, x) in zip(subtask.grounds if points else (), points, strict=True)
            ]
            saved = env.save() if snapshot.step % 10 == 0 else None
            found.append(Moment(snapshot, action, len(env.subtasks), subtask.text, tuple(groundings), saved))
            text_before, index_before = snapshot.grounded_subgoal, snapshot.subtask_index
            if snapshot.status is not Status.ONGOING:
                return tuple(found)
            action = next(actions)
            snapshot = env.step(action)

    return moments


def distance_px(env: Environment, body: str, yx_px: tuple[int, int]) -> float:
    """Distance of a pixel to the nearest one at which the front camera sees the body, along the worse axis."""
    return float(np.abs(sight.visible_pixels(env.physics, FRONT, body, IMAGE_PX) - yx_px).max(axis=1).min())


@every_task
@every_difficulty
def test_the_oracle_succeeds(walk: WalkOf, name: str, difficulty: str) -> None:
    last = walk(name, difficulty)[-1].snapshot
    assert (last.status, last.simple_subgoal) == (Status.SUCCESS, "All tasks completed")
    assert last.reason


@every_task
@every_difficulty
def test_snapshots_are_well_formed(walk: WalkOf, environment: EnvironmentOf, name: str, difficulty: str) -> None:
    env = environment(name)
    for step, moment in enumerate(walk(name, difficulty)):
        snapshot = moment.snapshot
        assert snapshot.step == step
        assert snapshot.state.shape == (8,)
        assert snapshot.state.dtype == np.float32
        assert snapshot.tcp_pose.shape == (7,)
        assert np.isfinite(snapshot.state).all()
        assert np.isfinite(snapshot.tcp_pose).all()
        assert np.all(snapshot.state >= env.physics.robot.state_low - 1e-3)
        assert np.all(snapshot.state <= env.physics.robot.state_high + 1e-3)
        assert 0 <= snapshot.subtask_index <= moment.num_subtasks


@every_task
@every_difficulty
def test_the_oracle_speaks_in_actions(walk: WalkOf, environment: EnvironmentOf, name: str, difficulty: str) -> None:
    env = environment(name)
    for before, moment in itertools.pairwise(walk(name, difficulty)):
        action = moment.action
        assert action.shape == (8,)
        assert action.dtype == np.float32
        assert np.all(action >= env.physics.robot.action_low)
        assert np.all(action <= env.physics.robot.action_high)
        assert np.abs(action[:7] - before.snapshot.state[:7]).max() < 0.25  # the arm can follow


@every_task
@every_difficulty
def test_texts_are_filled_and_change_with_the_subtask(walk: WalkOf, name: str, difficulty: str) -> None:
    for moment in walk(name, difficulty):
        snapshot = moment.snapshot
        assert "<>" not in snapshot.grounded_subgoal
        assert not set("[]") & set(snapshot.simple_subgoal + snapshot.grounded_subgoal)
        if snapshot.status is Status.ONGOING:
            plain = re.sub(r" at <\d+, \d+>", "", snapshot.grounded_subgoal)
            assert plain == snapshot.simple_subgoal
            assert snapshot.simple_subgoal == re.sub(r"\[.*?\]", "", moment.spoken)


@every_task
@every_difficulty
def test_fixed_coordinates_lie_on_the_object(
    walk: WalkOf, environment: EnvironmentOf, name: str, difficulty: str
) -> None:
    found = [grounding for moment in walk(name, difficulty) for grounding in moment.groundings]
    assert all(distance <= 2 and is_inside for distance, is_inside in found)
    if not found:
        environment(name).reset(SEED, difficulty)
        assert not any(subtask.grounds for subtask in environment(name).subtasks)


@every_task
def test_doing_nothing_never_succeeds(environment: EnvironmentOf, name: str) -> None:
    """On a table that has stood still for five seconds nothing more is to come."""
    env = environment(name)
    env.reset(SEED, "easy")
    places_m, num_still = env.physics.data.xpos.copy(), 0
    for _ in range(400):
        snapshot = env.step(HOME)
        assert snapshot.status is not Status.SUCCESS
        is_still = bool(np.abs(env.physics.data.xpos - places_m).max() < 1e-4)
        places_m, num_still = env.physics.data.xpos.copy(), (num_still + 1) * is_still
        if snapshot.status is not Status.ONGOING or num_still == 100:
            return


@every_task
@every_difficulty
def test_a_seed_gives_one_scene_and_another_seed_another(
    environment: EnvironmentOf, name: str, difficulty: str
) -> None:
    first, *layouts = [make_task(name).sample(np.random.default_rng(seed), difficulty) for seed in (0, *range(5))]
    assert first == layouts[0]
    environment(name).reset(SEED, difficulty)
    layouts.append(environment(name).layout)
    assert all(a != b for i, a in enumerate(layouts) for b in layouts[:i])


def saved_at(episode: Sequence[Moment]) -> list[tuple[int, EpisodeState]]:
    return [(step, moment.saved) for step, moment in enumerate(episode) if moment.saved is not None]


@every_task
def test_a_restored_episode_continues_bit_exactly(walk: WalkOf, environment: EnvironmentOf, name: str) -> None:
    env, episode = environment(name), walk(name, "hard")
    saved = saved_at(episode[:-1])
    for step, state in (saved[1], saved[min(13, len(saved) - 1)]):  # some episodes are short
        env.reset(SEED + 1, "easy")  # another episode in between
        assert facts(env.restore(state)) == facts(episode[step].snapshot)
        for moment in episode[step + 1 : step + 41]:
            assert facts(env.step(moment.action)) == facts(moment.snapshot)


@every_task
def test_the_oracle_can_take_over_anywhere(walk: WalkOf, environment: EnvironmentOf, name: str) -> None:
    """Taking over stops the arm, and in the last two seconds a task that is a matter of timing has none to lose."""
    env = environment(name)
    saved = saved_at(walk(name, "hard")[:-41])
    handover, state = saved[len(saved) * 2 // 3]
    env.restore(state)
    for action in env.oracle():
        snapshot = env.step(action)
        if snapshot.status is not Status.ONGOING:
            break
    assert snapshot.status is Status.SUCCESS, (handover, snapshot.reason)


@every_task
def test_snapshots_share_no_memory(environment: EnvironmentOf, name: str) -> None:
    env = environment(name)
    a, b = islice(snapshots(env, SEED, "easy"), 2)
    assert not np.shares_memory(a.state, b.state)
    assert not np.shares_memory(a.tcp_pose, b.tcp_pose)
    for array in (b.state, b.tcp_pose):
        assert not np.shares_memory(array, env.physics.data.qpos)
        assert array.flags.owndata


@every_fourth_task
@pytest.mark.sim
def test_frames_have_the_promised_shape_and_own_their_memory(name: str) -> None:
    with make_environment(name) as env:
        a, b = env.reset(SEED, "easy"), env.step(HOME)
        assert tuple(a.frames) == tuple(b.frames) == CAMERAS
        for camera in CAMERAS:
            assert a.frames[camera].shape == (IMAGE_PX, IMAGE_PX, 3)
            assert a.frames[camera].dtype == np.uint8
            assert a.frames[camera].std() > 10  # not blank
            assert not np.shares_memory(a.frames[camera], b.frames[camera])


@pytest.mark.parametrize("seed", [0, 1, 2, 12600])
def test_difficulty_follows_the_seed_unless_given(environment: EnvironmentOf, seed: int) -> None:
    env = environment("PickHighlight")
    env.reset(seed)
    assert env.difficulty == ("easy", "medium", "hard")[seed % 3]
    env.reset(seed, "hard")
    assert env.difficulty == "hard"


@every_task
@pytest.mark.parametrize(
    ("action", "complaint"),
    [
        (np.zeros(7), r"shape \(7,\); expected \(8,\)"),
        (np.zeros((1, 8)), r"shape \(1, 8\); expected \(8,\)"),
        (np.append(panda.HOME_QPOS, np.nan), "is not finite"),
        (np.append(panda.HOME_QPOS, np.inf), "is not finite"),
    ],
)
def test_a_bad_action_is_refused_and_changes_nothing(
    environment: EnvironmentOf, name: str, action: np.ndarray, complaint: str
) -> None:
    env = environment(name)
    env.reset(SEED, "easy")
    before = env.physics.data.qpos.copy()
    with pytest.raises(ValueError, match=complaint):
        env.step(action)
    np.testing.assert_array_equal(env.physics.data.qpos, before)
    assert env.step(HOME).step == 1


@every_task
def test_an_unknown_difficulty_is_refused(environment: EnvironmentOf, name: str) -> None:
    with pytest.raises(TaskError, match="unknown difficulty 'extreme'; expected one of easy, medium, hard"):
        environment(name).reset(0, "extreme")


@every_task
@every_difficulty
def test_a_video_can_be_watched_at_any_time_and_changes_nothing(
    environment: EnvironmentOf, name: str, difficulty: str
) -> None:
    env = environment(name)
    env.reset(SEED, difficulty)
    actions = list(islice(env.oracle(), 3))
    unwatched = [facts(env.step(action)) for action in actions]
    env.reset(SEED, difficulty)
    every_second = [facts(frame) for frame in env.demonstration(1)]
    frames, watched = env.demonstration(), []
    for action in actions:
        next(frames, None)  # half watched
        watched.append(facts(env.step(action)))
    assert watched == unwatched
    saved = env.save()
    env.reset(SEED + 1, "easy")
    env.restore(saved)
    assert [facts(frame) for frame in env.demonstration()][::20] == every_second


@every_task
def test_frames_of_a_video_are_well_formed(environment: EnvironmentOf, name: str) -> None:
    env = environment(name)
    env.reset(SEED, "easy")
    for step, frame in enumerate(env.demonstration()):
        assert frame.is_demonstration
        assert frame.step == step
        assert frame.status is Status.ONGOING
        assert np.isfinite(frame.state).all()
        assert frame.simple_subgoal
        assert "<>" not in frame.grounded_subgoal
    assert not env.step(HOME).is_demonstration


@every_task
@pytest.mark.parametrize("rate_hz", [0, -1, 3, 40])
def test_a_video_has_no_frames_between_its_frames(environment: EnvironmentOf, name: str, rate_hz: int) -> None:
    environment(name).reset(SEED, "easy")
    with pytest.raises(ValueError, match=f"20 Hz cannot be shown at {rate_hz} Hz; use 1, 2, 4, 5, 10 or 20"):
        environment(name).demonstration(rate_hz)


@pytest.mark.parametrize("names", [task_names()[::4], pytest.param(task_names(), marks=pytest.mark.acceptance)])
def test_another_process_walks_the_same_trajectories(walk: WalkOf, names: Sequence[str]) -> None:
    """The seed decides everything: here other episodes came before, there none."""
    script = f"""
import hashlib, sys
from dual_system.tasks.environment import make_environment
for name in sys.argv[1:]:
    env = make_environment(name, render=False)
    snapshot, digest, actions = env.reset({SEED}, "hard"), hashlib.sha256(), env.oracle()
    while snapshot.step < 100 and snapshot.status.value == "ongoing":
        snapshot = env.step(next(actions))
        digest.update(snapshot.state.tobytes() + snapshot.tcp_pose.tobytes())
    print(name, digest.hexdigest())
"""

    here = []
    for name in names:
        digest = hashlib.sha256()
        for moment in walk(name, "hard")[1:101]:
            digest.update(moment.snapshot.state.tobytes() + moment.snapshot.tcp_pose.tobytes())
        here.append(f"{name} {digest.hexdigest()}")
    there = subprocess.run([sys.executable, "-c", script, *names], capture_output=True, text=True, check=True)
    assert there.stdout.splitlines() == here
