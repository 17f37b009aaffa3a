"""Recorded episodes of the permanence family, placed in our world: the same clockwork, texts, places and length."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.geometry import Spot
from dual_system.tasks.permanence.scenes import Hidden, Layout

EnvironmentOf = Callable[[str], Environment]
Recording = dict[str, Any]

DATA = Path(__file__).parent / "data"
FILES = {
    "ButtonUnmask": "button_unmask",
    "VideoUnmask": "video_unmask",
    "ButtonUnmaskSwap": "button_unmask_swap",
    "VideoUnmaskSwap": "video_unmask_swap",
}
VIDEOS = ("VideoUnmask", "VideoUnmaskSwap")

every_task = pytest.mark.parametrize("name", FILES)


@functools.cache
def recording_of(name: str) -> Recording:
    """Measured values of one episode of the real benchmark."""
    recording: Recording = json.loads((DATA / f"{FILES[name]}_train006.json").read_text())
    return recording


def layout_of(recording: Recording) -> Layout:
    written = recording["layout"]
    return Layout(
        buttons_xy_m=tuple((x, y) for x, y in written["buttons_xy_m"]),
        containers=tuple(Spot(x_m=x, y_m=y, yaw_rad=yaw) for x, y, yaw in written["containers"]),
        hidden=tuple(Hidden(color=color, container=container) for color, container in written["hidden"]),
        num_picks=written["num_picks"],
        swaps=tuple((first, second) for first, second in written["swaps"]),
    )


@dataclass(frozen=True)
class Episode:
    """Everything seen in one episode: its video, its snapshots, and where things were at each instant of the clock."""

    video: list[Snapshot]
    snapshots: list[Snapshot]
    positions_m: list[np.ndarray]  # (n, 3) per instant, from the first frame of the video on


def body_of(thing: str, recording: Recording) -> str:
    """What we call something that the recording names; its cubes go by their colours, ours by what covers them."""
    under = {f"cube_{color}": f"cube_{container}" for color, container in recording["layout"]["hidden"]}
    return under.get(thing, thing)


def played(env: Environment, recording: Recording, actions: Callable[[], Iterable[np.ndarray]]) -> Episode:
    snapshots = [env.reset(recording["seed"], recording["difficulty"], layout=layout_of(recording))]
    names = [body_of(thing, recording) for thing in recording["track"]["names"]]
    first = env.save()
    positions_m = []
    for row in first.video:
        env.physics.load(row.physics)
        positions_m.append(np.array([env.physics.position_m(name) for name in names]))
    env.restore(first)
    positions_m.append(np.array([env.physics.position_m(name) for name in names]))
    for action in actions():
        snapshots.append(env.step(action))
        positions_m.append(np.array([env.physics.position_m(name) for name in names]))
        if snapshots[-1].status is not Status.ONGOING:
            break
    return Episode(video=list(env.demonstration()), snapshots=snapshots, positions_m=positions_m)


@pytest.fixture(scope="module")
def oracles(environment: EnvironmentOf) -> Callable[[str], Episode]:
    """Our oracle in the recorded scene, once per task."""
    return functools.cache(lambda name: played(environment(name), recording_of(name), environment(name).oracle))


@pytest.fixture(scope="module")
def replayed(environment: EnvironmentOf) -> Callable[[str], Episode]:
    """Our world under the recorded actions, once per task."""

    def replay(name: str) -> Episode:
        recording = recording_of(name)
        return played(environment(name), recording, lambda: map(np.array, recording["actions"]))

    return functools.cache(replay)


def texts(snapshots: list[Snapshot]) -> list[tuple[int, str, str]]:
    """Step, plain and grounded text at each change."""
    changes: list[tuple[int, str, str]] = []
    for snapshot in snapshots:
        said = (snapshot.simple_subgoal, snapshot.grounded_subgoal)
        if not changes or changes[-1][1:] != said:
            changes.append((snapshot.step, *said))
    return changes


def assert_same_texts(ours: list[tuple[int, str, str]], recording: Recording, phase: str, tolerance_px: int) -> None:
    theirs = [entry for entry in recording["subgoals"] if entry["phase"] == phase]
    assert [simple for _, simple, _ in ours] == [entry["simple_subgoal"] for entry in theirs]
    for (_, _, grounded), entry in zip(ours, theirs, strict=True):
        numbers, their_numbers = (re.findall(r"\d+", text) for text in (grounded, entry["grounded_subgoal"]))
        assert re.sub(r"\d+", "#", grounded) == re.sub(r"\d+", "#", entry["grounded_subgoal"])
        apart_px = np.abs(np.subtract([int(n) for n in numbers], [int(n) for n in their_numbers]))
        assert np.all(apart_px <= tolerance_px), (grounded, entry["grounded_subgoal"])


@every_task
def test_the_instruction_is_the_first_recorded_goal(environment: EnvironmentOf, name: str) -> None:
    recording = recording_of(name)
    environment(name).reset(0, layout=layout_of(recording))
    assert environment(name).instruction == recording["goal"]


@every_task
def test_the_recorded_actions_succeed_at_the_recorded_step(replayed: Callable[[str], Episode], name: str) -> None:
    last = replayed(name).snapshots[-1]
    assert last.status is Status.SUCCESS
    assert abs(last.step - recording_of(name)["exec_steps"]) <= 1


@every_task
def test_replayed_texts_are_the_recorded_ones(replayed: Callable[[str], Episode], name: str) -> None:
    recording = recording_of(name)
    ours = texts(replayed(name).snapshots)
    assert_same_texts(ours, recording, "exec", tolerance_px=1)
    theirs = [entry["step"] for entry in recording["subgoals"] if entry["phase"] == "exec"]
    assert np.abs(np.subtract([step for step, _, _ in ours], theirs)).max() <= 2


@every_task
def test_our_oracle_takes_the_recorded_time_and_says_the_recorded_texts(
    oracles: Callable[[str], Episode], name: str
) -> None:
    recording, episode = recording_of(name), oracles(name)
    assert episode.snapshots[-1].status is Status.SUCCESS
    assert episode.snapshots[-1].step == pytest.approx(recording["exec_steps"], rel=0.05)
    assert_same_texts(texts(episode.snapshots), recording, "exec", tolerance_px=1)


@every_task
def test_things_come_go_and_swap_as_recorded_at_every_step(replayed: Callable[[str], Episode], name: str) -> None:
    track, episode = recording_of(name)["track"], replayed(name)
    for clock, row in zip(track["clock"], track["xyz"], strict=True):
        for thing, theirs, ours_m in zip(track["names"], row, episode.positions_m[clock], strict=True):
            if theirs is None:
                assert np.abs(ours_m).max() > 5, (thing, clock)
            else:
                np.testing.assert_allclose(ours_m, np.multiply(theirs, 1e-4), atol=3e-4, err_msg=f"{thing} {clock}")


@pytest.mark.parametrize("name", VIDEOS)
def test_the_video_is_as_long_as_recorded_and_says_the_same(oracles: Callable[[str], Episode], name: str) -> None:
    recording, video = recording_of(name), oracles(name).video
    assert len(video) == recording["demo_frames"]
    assert_same_texts(texts(video), recording, "demo", tolerance_px=1)
    for entry in recording["demo_states"]:
        np.testing.assert_allclose(video[entry["row"]].state, entry["state"], atol=1e-4)


@every_task
def test_the_first_state_is_the_recorded_home(oracles: Callable[[str], Episode], name: str) -> None:
    np.testing.assert_allclose(oracles(name).snapshots[0].state, recording_of(name)["home_state"], atol=1e-4)
