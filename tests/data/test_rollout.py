"""The oracle's rows: each holds what was seen before its action, and playing the actions again gives them again."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator

import numpy as np
import pytest

from dual_system.data import rollout
from dual_system.data.episode import CAMERAS, Row, unpack
from dual_system.data.jobs import Job, Look
from dual_system.data.rollout import UNSOLVED, UnsolvedError, play, work_out
from dual_system.data.video import read_frames
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, make_environment
from dual_system.tasks.oracle import FailedGrasp


def job(task: str, slot: int = 6, **changes: object) -> Job:
    values = {"task": task, "slot": slot, "image_px": 32, "max_steps": 1300, "look": Look()}
    return Job(**values | changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def environment() -> Iterator[Environment]:
    """VideoUnmask, with a demonstration; nobody looks."""
    with make_environment("VideoUnmask", render=False) as env:
        yield env


@pytest.fixture(scope="module")
def rows(environment: Environment) -> list[Row]:
    found: list[Row] = []
    play(environment, job("VideoUnmask"), 3, take=lambda row, frames: found.append(row))
    return found


def test_a_row_is_what_was_seen_before_its_action(environment: Environment, rows: list[Row]) -> None:
    acted = [row for row in rows if not row.is_demonstration]
    snapshot = environment.reset(3, job("VideoUnmask").difficulty)
    for row in acted:
        assert snapshot.status is Status.ONGOING
        np.testing.assert_array_equal(row.state, snapshot.state)
        assert (row.subgoal, row.grounded_subgoal) == (snapshot.simple_subgoal, snapshot.grounded_subgoal)
        np.testing.assert_allclose(row.tcp_pose, snapshot.tcp_pose, atol=1e-6)
        snapshot = environment.step(row.action)
    assert snapshot.status is Status.SUCCESS


def test_a_demonstration_comes_first_and_its_reasoning_once(environment: Environment, rows: list[Row]) -> None:
    flags = [row.is_demonstration for row in rows]
    num_shown = flags.index(False)
    environment.reset(3, job("VideoUnmask").difficulty)
    shown = list(environment.demonstration())
    assert num_shown == len(shown) > 0
    assert not any(flags[num_shown:])
    for row, snapshot in zip(rows, shown, strict=False):
        np.testing.assert_array_equal(row.state, snapshot.state)
        np.testing.assert_array_equal(row.action, snapshot.command)
    assert [index for index, row in enumerate(rows) if row.demonstration_reasoning] == [num_shown]
    assert rows[num_shown].demonstration_reasoning == environment.reasoning()


def test_an_episode_without_a_demonstration_has_nothing_to_reason_about() -> None:
    found: list[Row] = []
    with make_environment("StopCube", render=False) as env:
        play(env, job("StopCube"), 6, take=lambda row, frames: found.append(row))
    assert {(row.is_demonstration, row.demonstration_reasoning) for row in found} == {(False, "")}


@pytest.mark.parametrize("task", ["PickXtimes", "RouteStick", "VideoUnmask", "InsertPeg"])  # the first two repeat words
def test_a_transition_is_where_the_next_subtask_is_spoken_of(task: str) -> None:
    """The texts follow the engine by one step, and two subtasks in a row may have the same words."""
    found: list[Row] = []
    indices: list[int] = []
    with make_environment(task, render=False) as env:
        for seed in range(3, 9):  # the oracle does not solve every scene
            found.clear()
            with contextlib.suppress(UnsolvedError):
                play(env, job(task), seed, take=lambda row, frames: found.append(row))
                break
        acted = [row for row in found if not row.is_demonstration]
        snapshot = env.reset(seed, job(task).difficulty)
        for row in acted:
            indices.append(snapshot.subtask_index)
            snapshot = env.step(row.action)
    told = [0, *indices[:-1]]
    expected = [index == 0 or told[index] != told[index - 1] for index in range(len(told))]
    assert [row.is_transition for row in acted] == expected
    assert not any(row.is_transition for row in found if row.is_demonstration)


def test_an_episode_in_vain_is_not_kept() -> None:
    with (
        make_environment("VideoUnmask", render=False, max_steps=20) as env,
        pytest.raises(UnsolvedError, match="20 steps"),
    ):
        play(env, job("VideoUnmask"), 3)


def test_the_failed_grasp_is_in_the_rows(environment: Environment, rows: list[Row]) -> None:
    found: list[Row] = []
    fails = FailedGrasp(before=0, offset=(0, 0, 1))
    play(environment, job("VideoUnmask"), 3, fails, lambda row, frames: found.append(row))
    closings = [np.diff([row.action[7] for row in each if not row.is_demonstration]) < 0 for each in (rows, found)]
    assert [int(each.sum()) for each in closings] == [1, 2]


def test_seeds_are_tried_in_turn_and_all_are_accounted_for(monkeypatch: pytest.MonkeyPatch) -> None:
    def solve(environment: Environment, job: Job, seed: int, rejected: tuple[object, ...]) -> dict[str, bytes]:
        if seed < job.seed(solved_by):
            raise UnsolvedError(f"no luck with {seed}")
        return {"seed": str(seed).encode(), "rejected": str(len(rejected)).encode()}

    monkeypatch.setattr(rollout, "kept_environment", lambda *args, **options: None)
    monkeypatch.setattr(rollout, "_solve", solve)
    solved_by = 3
    assert work_out(job("VideoUnmask")) == {"seed": str(job("VideoUnmask").seed(3)).encode(), "rejected": b"3"}
    solved_by = 100
    tried = json.loads(work_out(job("VideoUnmask"))[UNSOLVED])
    assert [each["seed"] for each in tried] == [job("VideoUnmask").seed(attempt) for attempt in range(100)]


@pytest.mark.sim
def test_pictures_belong_to_their_rows_and_only_those_wanted_are_rendered(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    look = Look(demonstration_hz=1, execution_hz=5)
    episode = unpack(work_out(job("VideoUnmask", look=look)))
    num_shown = int(episode.rows.is_demonstration.sum())
    rendered = episode.rows.is_rendered.nonzero()[0]
    expected = {*range(0, num_shown, 20), num_shown - 1, *range(num_shown, len(episode.rows), 4)}
    assert rendered.tolist() == sorted(expected)
    path = tmp_path_factory.mktemp("pictures")
    with make_environment("VideoUnmask", image_px=32) as env:
        snapshot = env.reset(episode.about.seed, episode.about.difficulty)
        for row in range(num_shown, num_shown + 9):
            if row in rendered:
                seen = snapshot.frames
            for camera in CAMERAS:
                (path / camera).write_bytes(episode.videos[camera])
                (frame,) = read_frames(path / camera, [row])
                error = np.abs(frame.astype(float) - seen[camera]).mean()
                assert error < 12  # what the codec takes from 32 px of colour; another moment's picture differs more
            snapshot = env.step(episode.rows.action[row])


@pytest.mark.sim
def test_texts_count_in_256_px_whatever_is_rendered(rows: list[Row]) -> None:
    with make_environment("VideoUnmask", image_px=32) as env:
        seen = env.reset(3, job("VideoUnmask").difficulty)
        said = [row.grounded_subgoal for row in rows if not row.is_demonstration]
        assert seen.frames["front"].shape == (32, 32, 3)
        assert seen.grounded_subgoal == said[0]
        assert any(int(number) >= 32 for number in re.findall(r"\d+", said[0]))
