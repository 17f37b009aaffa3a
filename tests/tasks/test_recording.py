"""The real benchmark's recorded episode, placed in our world: same cameras, same texts, same clockwork."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dual_system.tasks import panda, sight
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.reference.pick_highlight import Layout
from dual_system.tasks.scene import FRONT, WRIST


def texts(snapshots: list[Snapshot]) -> list[dict[str, Any]]:
    """The texts at each change, in the recording's form."""
    changes: list[dict[str, Any]] = []
    for snapshot in snapshots:
        said = {"simple_subgoal": snapshot.simple_subgoal, "grounded_subgoal": snapshot.grounded_subgoal}
        if not changes or {key: changes[-1][key] for key in said} != said:
            changes.append({"step": snapshot.step, **said})
    return changes


def step_of(recording: dict[str, Any], kind: str, nth: int = 0) -> int:
    return [event["step"] for event in recording["events"] if event["type"] == kind][nth]


@pytest.fixture(scope="module")
def replayed(pick_highlight: Environment, recorded_layout: Layout, recording: dict[str, Any]) -> list[Snapshot]:
    """Our world under the recorded actions."""
    snapshots = [pick_highlight.reset(recording["seed"], recording["difficulty"], layout=recorded_layout)]
    for action in recording["actions"]:
        snapshots.append(pick_highlight.step(action))
        if snapshots[-1].status is not Status.ONGOING:
            break
    return snapshots


@pytest.fixture(scope="module")
def oracles(pick_highlight: Environment, recorded_layout: Layout, recording: dict[str, Any]) -> list[Snapshot]:
    """Our oracle in the recorded scene."""
    snapshots = [pick_highlight.reset(recording["seed"], recording["difficulty"], layout=recorded_layout)]
    for action in pick_highlight.oracle():
        snapshots.append(pick_highlight.step(action))
        if snapshots[-1].status is not Status.ONGOING:
            break
    return snapshots


def test_the_first_state_is_the_recorded_home(replayed: list[Snapshot], recording: dict[str, Any]) -> None:
    np.testing.assert_allclose(replayed[0].state, recording["home_state"], atol=1e-4)
    np.testing.assert_allclose(replayed[0].tcp_pose[:3], recording["home_tcp_m"], atol=1e-4)


def test_the_recorded_actions_succeed_at_the_recorded_step(replayed: list[Snapshot], recording: dict[str, Any]) -> None:
    assert replayed[-1].status is Status.SUCCESS
    assert replayed[-1].step == recording["exec_steps"]


def test_the_recorded_actions_lead_through_the_recorded_states(
    replayed: list[Snapshot], recording: dict[str, Any]
) -> None:
    for entry in recording["states"]:
        ours = replayed[entry["step"]].state
        # 10 mrad while a finger pushes on something (contacts are another engine's), 3 mrad in the air
        np.testing.assert_allclose(ours[:7], entry["state"][:7], atol=0.003 if entry["step"] < 77 else 0.011)
        assert ours[7] == pytest.approx(entry["state"][7], abs=0.006)


def test_replayed_texts_are_the_recorded_ones(replayed: list[Snapshot], recording: dict[str, Any]) -> None:
    ours, theirs = texts(replayed), recording["subgoals"]
    assert [entry["simple_subgoal"] for entry in ours] == [entry["simple_subgoal"] for entry in theirs]
    for a, b in zip(ours, theirs, strict=True):
        assert abs(a["step"] - b["step"]) <= 2
        assert_same_text(a["grounded_subgoal"], b["grounded_subgoal"], tolerance_px=1)


def test_our_oracle_keeps_the_recorded_schedule(oracles: list[Snapshot], recording: dict[str, Any]) -> None:
    index_at = [snapshot.subtask_index for snapshot in oracles]
    for nth in range(4):
        assert index_at.index(nth + 1) == pytest.approx(step_of(recording, "subtask_completed", nth), rel=0.08)
    assert oracles[-1].step == pytest.approx(recording["exec_steps"], rel=0.06)


def test_our_oracles_texts_are_the_recorded_ones(oracles: list[Snapshot], recording: dict[str, Any]) -> None:
    ours, theirs = texts(oracles), recording["subgoals"]
    assert len(ours) == len(theirs)
    for a, b in zip(ours, theirs, strict=True):
        assert a["simple_subgoal"] == b["simple_subgoal"]
        assert_same_text(a["grounded_subgoal"], b["grounded_subgoal"], tolerance_px=1)


def test_the_instruction_is_the_first_recorded_goal(
    pick_highlight: Environment, oracles: list[Snapshot], recording: dict[str, Any]
) -> None:
    assert oracles
    assert pick_highlight.instruction == recording["goals"][0]


def test_the_front_camera_is_the_recorded_one(pick_highlight: Environment, recording: dict[str, Any]) -> None:
    pick_highlight.reset(0)
    points_m = np.array([[x, y, z] for x in (-0.5, -0.2, 0.1) for y in (-0.3, 0.3) for z in (0.0, 0.2)])
    ours = sight.project(
        sight.intrinsic(pick_highlight.physics, FRONT, 256), sight.extrinsic(pick_highlight.physics, FRONT), points_m
    )
    theirs = sight.project(np.array(recording["front_intrinsic"]), np.array(recording["front_extrinsic"]), points_m)
    assert np.abs(ours - theirs).max() < 0.05


def test_the_wrist_camera_is_the_recorded_one(pick_highlight: Environment, recording: dict[str, Any]) -> None:
    physics = pick_highlight.physics
    for entry in recording["wrist"]:
        physics.reset()
        for name, angle_rad in zip(panda.ARM_JOINTS, entry["state"], strict=False):
            physics.data.joint(name).qpos = angle_rad
        physics.refresh()
        x_m, y_m, z_m = physics.tcp_transform()[:3, 3]
        offsets_m = np.array([[0, 0, 0], [0.1, 0, -0.1], [0, 0.1, -0.1], [0.1, -0.1, -0.1]])
        points_m = offsets_m + np.array([x_m, y_m, z_m])
        ours = sight.project(sight.intrinsic(physics, WRIST, 256), sight.extrinsic(physics, WRIST), points_m)
        theirs = sight.project(np.array(recording["wrist_intrinsic"]), np.array(entry["extrinsic"]), points_m)
        assert np.abs(ours - theirs).max() < 0.5


def assert_same_text(ours: str, theirs: str, *, tolerance_px: int) -> None:
    """Equal up to small differences of the numbers in them."""

    def split(text: str) -> tuple[str, list[int]]:
        words = text.replace("<", " ").replace(">", " ").replace(",", " ").split()
        return " ".join(w for w in words if not w.isdigit()), [int(w) for w in words if w.isdigit()]

    our_words, our_numbers = split(ours)
    their_words, their_numbers = split(theirs)
    assert our_words == their_words
    assert len(our_numbers) == len(their_numbers)
    assert np.all(np.abs(np.subtract(our_numbers, their_numbers)) <= tolerance_px), (ours, theirs)
