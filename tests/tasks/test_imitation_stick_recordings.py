"""Recorded episodes of the stick robot, placed in our world: the same texts, places, reds, motions and length."""

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

from dual_system.tasks import panda
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.imitation import pattern_lock, route_stick
from dual_system.tasks.kinematics import Kinematics

EnvironmentOf = Callable[[str], Environment]
Recording = dict[str, Any]

DATA = Path(__file__).parent / "data"
FILES = {"PatternLock": "pattern_lock", "RouteStick": "route_stick"}

every_task = pytest.mark.parametrize("name", FILES)


@functools.cache
def recording_of(name: str) -> Recording:
    """Measured values of one episode of the real benchmark."""
    recording: Recording = json.loads((DATA / f"{FILES[name]}_train006.json").read_text())
    return recording


def layout_of(name: str) -> pattern_lock.Layout | route_stick.Layout:
    written = recording_of(name)["layout"]
    if name == "PatternLock":
        return pattern_lock.Layout(side=written["side"], pattern=tuple(written["pattern"]))
    return route_stick.Layout(
        turn_rad=written["turn_rad"],
        post_colors=tuple((r, g, b) for r, g, b in written["post_colors"]),
        route=tuple(written["route"]),
        sides=tuple(written["sides"]),
    )


@dataclass(frozen=True)
class Episode:
    """What was seen in one episode, and which targets were red in it: a row per frame of the video or snapshot."""

    video: list[Snapshot]
    snapshots: list[Snapshot]
    reasoning: str
    red_in_video: list[frozenset[str]]
    red: list[frozenset[str]]


def reds(env: Environment) -> frozenset[str]:
    model = env.physics.model
    names = [model.geom(geom).name for geom in range(model.ngeom) if model.geom_rgba[geom, 3] > 0]
    return frozenset(name.removesuffix("/red/0") for name in names if name.endswith("/red/0"))


def played(env: Environment, name: str, actions: Callable[[], Iterable[np.ndarray]]) -> Episode:
    snapshots = [env.reset(recording_of(name)["seed"], layout=layout_of(name))]
    reasoning, first, red_in_video = env.reasoning(), env.save(), []
    for row in first.video:
        env.physics.load(row.physics)
        red_in_video.append(reds(env))
    env.restore(first)
    red = [reds(env)]
    for action in actions():
        snapshots.append(env.step(action))
        red.append(reds(env))
        if snapshots[-1].status is not Status.ONGOING:
            break
    return Episode(
        video=list(env.demonstration()), snapshots=snapshots, reasoning=reasoning, red_in_video=red_in_video, red=red
    )


@pytest.fixture(scope="module")
def environment(remembering: EnvironmentOf) -> EnvironmentOf:
    return remembering


@pytest.fixture(scope="module")
def oracles(environment: EnvironmentOf) -> Callable[[str], Episode]:
    """Our oracle in the recorded scene, once per task."""
    return functools.cache(lambda name: played(environment(name), name, environment(name).oracle))


@pytest.fixture(scope="module")
def replayed(environment: EnvironmentOf) -> Callable[[str], Episode]:
    """Our world under the recorded actions, once per task."""
    return functools.cache(
        lambda name: played(environment(name), name, lambda: map(np.array, recording_of(name)["actions"]))
    )


def texts(snapshots: list[Snapshot]) -> list[tuple[int, str, str]]:
    """Step, plain and grounded text at each change."""
    changes: list[tuple[int, str, str]] = []
    for snapshot in snapshots:
        said = (snapshot.simple_subgoal, snapshot.grounded_subgoal)
        if not changes or changes[-1][1:] != said:
            changes.append((snapshot.step, *said))
    return changes


def recorded_texts(name: str, phase: str) -> list[tuple[int, str, str]]:
    return [
        (entry["step"], entry["simple_subgoal"], entry["grounded_subgoal"])
        for entry in recording_of(name)["subgoals"]
        if entry["phase"] == phase
    ]


def assert_same_texts(
    ours: list[tuple[int, str, str]], theirs: list[tuple[int, str, str]], *, within_steps: int
) -> None:
    assert [said for _, *said in ours] == [said for _, *said in theirs]
    assert np.abs(np.subtract([step for step, *_ in ours], [step for step, *_ in theirs])).max() <= within_steps


@every_task
def test_the_instruction_is_the_first_recorded_goal(environment: EnvironmentOf, name: str) -> None:
    environment(name).reset(0, layout=layout_of(name))
    assert environment(name).instruction == recording_of(name)["goal"]


@every_task
def test_things_stand_where_they_were_recorded(environment: EnvironmentOf, name: str) -> None:
    environment(name).reset(0, layout=layout_of(name))
    for thing, place_m in recording_of(name)["places"]:
        np.testing.assert_allclose(environment(name).physics.position_m(thing), place_m, atol=2e-5, err_msg=thing)


@every_task
def test_our_oracle_takes_the_recorded_time_and_says_the_recorded_texts(
    oracles: Callable[[str], Episode], name: str
) -> None:
    episode = oracles(name)
    assert episode.snapshots[-1].status is Status.SUCCESS
    assert episode.snapshots[-1].step == pytest.approx(recording_of(name)["exec_steps"], abs=2)
    assert_same_texts(texts(episode.snapshots), recorded_texts(name, "exec"), within_steps=2)


@every_task
def test_the_video_is_as_long_as_recorded_and_says_and_does_the_same(
    oracles: Callable[[str], Episode], name: str
) -> None:
    recording, video = recording_of(name), oracles(name).video
    assert len(video) == recording["demo_frames"]
    assert_same_texts(texts(video), recorded_texts(name, "demo"), within_steps=1)
    for entry in recording["demo_states"]:
        np.testing.assert_allclose(video[entry["row"]].state, entry["state"], atol=0.02)


@every_task
def test_execution_begins_in_the_recorded_posture(oracles: Callable[[str], Episode], name: str) -> None:
    np.testing.assert_allclose(oracles(name).snapshots[0].state, recording_of(name)["exec_state"], atol=0.01)


@every_task
def test_the_recorded_actions_succeed_at_the_recorded_step_on_the_recorded_way(
    replayed: Callable[[str], Episode], name: str
) -> None:
    recording, snapshots = recording_of(name), replayed(name).snapshots
    assert snapshots[-1].status is Status.SUCCESS
    assert abs(snapshots[-1].step - recording["exec_steps"]) <= 1
    assert_same_texts(texts(snapshots), recorded_texts(name, "exec"), within_steps=1)
    for entry in recording["tcp"][1:]:
        if entry["step"] < len(snapshots):
            np.testing.assert_allclose(snapshots[entry["step"]].tcp_pose[:3], entry["position_m"], atol=2e-3)


@every_task
def test_recorded_joints_put_the_tip_where_it_was(environment: EnvironmentOf, name: str) -> None:
    arm, recording = Kinematics(environment(name).physics.model), recording_of(name)
    np.testing.assert_allclose(arm.tcp(panda.HOME_QPOS)[:3, 3], recording["home_tcp_m"], atol=1e-4)
    at_start_m = arm.tcp(np.array(recording["exec_state"][:7]))[:3, 3]
    np.testing.assert_allclose(at_start_m, recording["tcp"][0]["position_m"], atol=2e-5)


@every_task
@pytest.mark.parametrize("phase", ["demo", "exec"])
def test_targets_are_red_when_they_were(replayed: Callable[[str], Episode], name: str, phase: str) -> None:
    """The recording notes red as soon as it is put there, which is one step before a picture shows it."""
    episode = replayed(name)
    rows = episode.red_in_video if phase == "demo" else episode.red
    for target, changes in recording_of(name)["red_rows"][phase].items():
        ours = [row for row in range(1, len(rows)) if (target in rows[row]) != (target in rows[row - 1])]
        theirs = [row + 1 for row in changes if 0 < row < len(rows) - 3]
        ours = [row for row in ours if row < len(rows) - 2]
        assert len(ours) == len(theirs), target
        assert all(abs(a - b) <= 2 for a, b in zip(ours, theirs, strict=True)), (target, ours, theirs)


@every_task
def test_coordinates_are_where_the_recorded_camera_sees_the_targets(
    oracles: Callable[[str], Episode], name: str
) -> None:
    """Upstream grounds no text of these tasks; its camera matrices say where its targets are in the picture."""
    ours = [(int(y), int(x)) for y, x in re.findall(r"<(\d+), (\d+)>", oracles(name).reasoning)]
    assert np.abs(np.subtract(ours, recording_of(name)["pixels_of_path"])).max() <= 4
