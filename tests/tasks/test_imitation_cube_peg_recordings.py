"""Recorded episodes of MoveCube and InsertPeg, placed in our world: the same texts, places and lengths."""

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
from dual_system.tasks.imitation import insert_peg, move_cube
from dual_system.tasks.placing import PlacedCube

EnvironmentOf = Callable[[str], Environment]
Recording = dict[str, Any]

DATA = Path(__file__).parent / "data"
FILES = {"MoveCube": "move_cube", "InsertPeg": "insert_peg"}
TOLERANCE_PX = 1

every_task = pytest.mark.parametrize("name", FILES)


@functools.cache
def recording_of(name: str) -> Recording:
    """Measured values of one episode of the real benchmark."""
    recording: Recording = json.loads((DATA / f"{FILES[name]}_train006.json").read_text())
    return recording


def spot(written: list[float]) -> Spot:
    x_m, y_m, yaw_rad = written
    return Spot(x_m=x_m, y_m=y_m, yaw_rad=yaw_rad)


def scene(written: Recording) -> move_cube.Scene:
    x_m, y_m, yaw_rad = written["cube"]
    return move_cube.Scene(
        cube=PlacedCube(x_m=x_m, y_m=y_m, yaw_rad=yaw_rad, color="red"),
        target_xy_m=tuple(written["target"]),
        peg=spot(written["peg"]),
    )


def layout_of(name: str) -> Any:
    written = recording_of(name)["layout"]
    if name == "MoveCube":
        return move_cube.Layout(
            manner=written["manner"], demonstrated=scene(written["demonstrated"]), asked=scene(written["asked"])
        )
    return insert_peg.Layout(
        box=spot(written["box"]),
        pegs=tuple(map(spot, written["pegs"])),
        head_linear=tuple(written["head_linear"]),
        grasped=written["grasped"],
        side=written["side"],
    )


@dataclass(frozen=True)
class Episode:
    """Everything said in one episode, and where the tracked bodies were at each of its observations."""

    instruction: str
    video: list[Snapshot]
    snapshots: list[Snapshot]
    positions_m: list[dict[str, np.ndarray]]


def played(env: Environment, name: str, actions: Callable[[], Iterable[Any]]) -> Episode:
    tracked = ("cube",) if name == "MoveCube" else ("peg_0/head", "peg_0/tail")
    recording = recording_of(name)
    snapshots = [env.reset(recording["seed"], recording["difficulty"], layout=layout_of(name))]
    positions_m = [{body: env.physics.position_m(body) for body in tracked}]
    for action in actions():
        snapshots.append(env.step(action))
        positions_m.append({body: env.physics.position_m(body) for body in tracked})
        if snapshots[-1].status is not Status.ONGOING:
            break
    return Episode(
        instruction=env.instruction, video=list(env.demonstration()), snapshots=snapshots, positions_m=positions_m
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
    return functools.cache(lambda name: played(environment(name), name, lambda: recording_of(name)["actions"]))


def texts(snapshots: list[Snapshot]) -> list[tuple[int, str, str]]:
    """Step, plain and grounded text at each change."""
    changes: list[tuple[int, str, str]] = []
    for snapshot in snapshots:
        said = (snapshot.simple_subgoal, snapshot.grounded_subgoal)
        if not changes or changes[-1][1:] != said:
            changes.append((snapshot.step, *said))
    return changes


def assert_same_texts(snapshots: list[Snapshot], recording: Recording, phase: str) -> None:
    ours, theirs = texts(snapshots), [entry for entry in recording["subgoals"] if entry["phase"] == phase]
    assert [simple for _, simple, _ in ours] == [entry["simple_subgoal"] for entry in theirs]
    for (_, _, grounded), entry in zip(ours, theirs, strict=True):
        numbers, their_numbers = (re.findall(r"\d+", text) for text in (grounded, entry["grounded_subgoal"]))
        assert re.sub(r"\d+", "#", grounded) == re.sub(r"\d+", "#", entry["grounded_subgoal"])
        apart_px = np.abs(np.subtract([int(n) for n in numbers], [int(n) for n in their_numbers]))
        assert np.all(apart_px <= TOLERANCE_PX), (grounded, entry["grounded_subgoal"])


@every_task
def test_the_instruction_is_the_first_recorded_goal(oracles: Callable[[str], Episode], name: str) -> None:
    assert oracles(name).instruction == recording_of(name)["goal"]


@every_task
def test_our_oracle_says_the_recorded_texts_in_the_recorded_time(oracles: Callable[[str], Episode], name: str) -> None:
    recording, episode = recording_of(name), oracles(name)
    assert episode.snapshots[-1].status is Status.SUCCESS
    assert episode.snapshots[-1].step == pytest.approx(recording["exec_steps"], rel=0.1)
    theirs = [entry for entry in recording["subgoals"] if entry["phase"] == "exec"]
    assert episode.snapshots[0].grounded_subgoal == theirs[0]["grounded_subgoal"]
    # Only the words of the later ones: how much of a target the hand hides just then depends on its exact way there.
    assert list(dict.fromkeys(snapshot.simple_subgoal for snapshot in episode.snapshots)) == [
        entry["simple_subgoal"] for entry in theirs
    ]


@every_task
def test_the_video_says_the_recorded_texts_in_the_recorded_time(oracles: Callable[[str], Episode], name: str) -> None:
    recording, episode = recording_of(name), oracles(name)
    assert len(episode.video) == pytest.approx(recording["demo_frames"], rel=0.1)
    assert_same_texts(episode.video, recording, "demo")


@every_task
def test_the_execution_begins_at_the_recorded_home(oracles: Callable[[str], Episode], name: str) -> None:
    np.testing.assert_allclose(oracles(name).snapshots[0].state, recording_of(name)["home_state"], atol=2e-4)


@every_task
def test_the_recorded_actions_succeed_when_they_did(replayed: Callable[[str], Episode], name: str) -> None:
    recording, episode = recording_of(name), replayed(name)
    last = episode.snapshots[-1]
    assert last.status is Status.SUCCESS, last.reason
    assert abs(last.step - recording["exec_steps"]) <= 1
    assert_same_texts(episode.snapshots, recording, "exec")
    theirs = [entry["step"] for entry in recording["subgoals"] if entry["phase"] == "exec"]
    assert np.abs(np.subtract([step for step, _, _ in texts(episode.snapshots)], theirs)).max() <= 1


def test_the_peg_hangs_in_the_hand_as_recorded(replayed: Callable[[str], Episode]) -> None:
    positions_m = replayed("InsertPeg").positions_m
    for entry in recording_of("InsertPeg")["lifted"]:
        for end in ("peg_0/head", "peg_0/tail"):
            np.testing.assert_allclose(
                positions_m[min(entry["step"], len(positions_m) - 1)][end], entry[end], atol=0.01
            )


def test_the_cube_ends_where_it_was_set_down(replayed: Callable[[str], Episode]) -> None:
    ended_m = replayed("MoveCube").positions_m[-1]["cube"]
    np.testing.assert_allclose(ended_m, recording_of("MoveCube")["final_cube_m"], atol=0.01)
