"""Recorded episodes of the counting family, placed in our world: our oracle's schedule and texts, and their actions."""

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

from dual_system.tasks.counting import bin_fill, pick_x_times, stop_cube, swing_x_times
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.geometry import Footprint
from dual_system.tasks.placing import PlacedCube

EnvironmentOf = Callable[[str], Environment]
Recording = dict[str, Any]

DATA = Path(__file__).parent / "data"


def cubes(recording: Recording) -> tuple[PlacedCube, ...]:
    return tuple(PlacedCube(**cube) for cube in recording["cubes"])


def pick_x_times_layout(recording: Recording) -> pick_x_times.Layout:
    return pick_x_times.Layout(
        button_xy_m=tuple(recording["button_xy_m"]),
        cubes=cubes(recording),
        target_xy_m=tuple(recording["target_xy_m"]),
        asked=recording["cube_names"].index(recording["task_parameters"]["target_cube"]),
        repeats=recording["task_parameters"]["repeats"],
    )


def bin_fill_layout(recording: Recording) -> bin_fill.Layout:
    lies = recording["bin"]
    return bin_fill.Layout(
        button_xy_m=tuple(recording["button_xy_m"]),
        bin=Footprint(center_m=tuple(lies["xy_m"]), half_m=(0.05, 0.05), yaw_rad=lies["yaw_rad"]),
        cubes=cubes(recording),
        wanted=tuple((color, count) for color, count in recording["task_parameters"]["colours_to_put_in"]),
        is_filling_up=recording["task_parameters"]["cubes_appear_over_time"],
    )


def swing_x_times_layout(recording: Recording) -> swing_x_times.Layout:
    return swing_x_times.Layout(
        button_xy_m=tuple(recording["button_xy_m"]),
        cubes=cubes(recording),
        right_xy_m=tuple(recording["target_right_xy_m"]),
        left_xy_m=tuple(recording["target_left_xy_m"]),
        asked=recording["cube_names"].index(recording["task_parameters"]["target_cube"]),
        repeats=recording["task_parameters"]["repeats"],
    )


def stop_cube_layout(recording: Recording) -> stop_cube.Layout:
    parameters = recording["task_parameters"]
    x_m, y_m = np.subtract(parameters["end_pos_xy"], parameters["start_pos_xy"])
    return stop_cube.Layout(
        button_xy_m=tuple(recording["button_xy_m"]),
        target_xy_m=tuple(recording["target_xy_m"]),
        heading_rad=float(np.arctan2(-x_m, y_m)),
        color_linear=tuple(recording["cube_color_linear"]),
        pass_steps=parameters["steps_per_pass"],
        visit=parameters["required_visit"],
    )


LAYOUTS: dict[str, tuple[str, Callable[[Recording], Any]]] = {
    "PickXtimes": ("pick_x_times", pick_x_times_layout),
    "BinFill": ("bin_fill", bin_fill_layout),
    "SwingXtimes": ("swing_x_times", swing_x_times_layout),
    "StopCube": ("stop_cube", stop_cube_layout),
}
every_task = pytest.mark.parametrize("name", LAYOUTS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Twin:
    """One recording beside our world: under its actions, and under our oracle."""

    recording: Recording
    instruction: str
    replayed: list[Snapshot]
    oracles: list[Snapshot]
    cube_xy_m: np.ndarray  # of StopCube's shuttle, per replayed snapshot


@pytest.fixture(scope="module")
def twin(environment: EnvironmentOf) -> Callable[[str], Twin]:
    @functools.cache
    def of(name: str) -> Twin:
        env = environment(name)
        file, layout_of = LAYOUTS[name]
        recording = json.loads((DATA / f"{file}_train006.json").read_text())
        track: list[np.ndarray] = []

        def play(actions: Callable[[], Iterable[Any]]) -> list[Snapshot]:
            track.clear()
            snapshots = [env.reset(recording["seed"], recording["difficulty"], layout=layout_of(recording))]
            for action in actions():
                if name == "StopCube":
                    track.append(env.physics.position_m("shuttle")[:2])
                snapshots.append(env.step(action))
                if snapshots[-1].status is not Status.ONGOING:
                    break
            return snapshots

        oracles = play(env.oracle)
        replayed = play(lambda: recording["actions"])
        return Twin(
            recording=recording,
            instruction=env.instruction,
            replayed=replayed,
            oracles=oracles,
            cube_xy_m=np.array(track),
        )

    return of


def texts(snapshots: list[Snapshot]) -> list[Recording]:
    """The texts at each change, in the recording's form."""
    changes: list[Recording] = []
    for snapshot in snapshots:
        said = {"simple_subgoal": snapshot.simple_subgoal, "grounded_subgoal": snapshot.grounded_subgoal}
        if not changes or {key: changes[-1][key] for key in said} != said:
            changes.append({"step": snapshot.step, **said})
    return changes


def differences_px(ours: str, theirs: str) -> list[int]:
    """How far the coordinates in two texts are apart; the words must be the same."""
    assert re.sub(r"\d+", "#", ours) == re.sub(r"\d+", "#", theirs)
    return [abs(int(a) - int(b)) for a, b in zip(re.findall(r"\d+", ours), re.findall(r"\d+", theirs), strict=True)]


@every_task
def test_the_instruction_is_the_first_recorded_goal(twin: Callable[[str], Twin], name: str) -> None:
    assert twin(name).instruction == twin(name).recording["goals"][0]


@every_task
def test_our_oracle_succeeds_in_about_the_recorded_time(twin: Callable[[str], Twin], name: str) -> None:
    last = twin(name).oracles[-1]
    assert last.status is Status.SUCCESS
    assert last.step == pytest.approx(twin(name).recording["exec_steps"], rel=0.05)


@every_task
def test_our_oracles_texts_are_the_recorded_ones(twin: Callable[[str], Twin], name: str) -> None:
    ours, theirs = texts(twin(name).oracles), twin(name).recording["subgoals"]
    assert [a["simple_subgoal"] for a in ours] == [b["simple_subgoal"] for b in theirs]
    for a, b in zip(ours, theirs, strict=True):
        assert max(differences_px(a["grounded_subgoal"], b["grounded_subgoal"]), default=0) <= 2, (a, b)


@every_task
def test_the_recorded_actions_lead_through_the_recorded_states(twin: Callable[[str], Twin], name: str) -> None:
    for entry in twin(name).recording["states"]:
        ours = twin(name).replayed[entry["step"]].state
        np.testing.assert_allclose(ours[:7], entry["state"][:7], atol=0.008)


@every_task
def test_the_recorded_actions_succeed_at_the_recorded_step(twin: Callable[[str], Twin], name: str) -> None:
    last = twin(name).replayed[-1]
    assert last.status is Status.SUCCESS, last.reason
    assert last.step == twin(name).recording["exec_steps"]


@every_task
def test_replayed_texts_change_when_the_recorded_ones_do(twin: Callable[[str], Twin], name: str) -> None:
    ours, theirs = texts(twin(name).replayed), twin(name).recording["subgoals"]
    assert len(ours) == len(theirs)
    for a, b in zip(ours, theirs, strict=True):
        assert abs(a["step"] - b["step"]) <= 1, (a, b)
        assert max(differences_px(a["grounded_subgoal"], b["grounded_subgoal"]), default=0) <= 1, (a, b)


def test_the_shuttle_runs_as_recorded(twin: Callable[[str], Twin]) -> None:
    ours, theirs = twin("StopCube").cube_xy_m, np.array(twin("StopCube").recording["cube_xy_m"])
    assert len(ours) == len(theirs) - 1  # the recording has the final state too
    assert np.linalg.norm(ours - theirs[:-1], axis=1).max() < 0.0005
