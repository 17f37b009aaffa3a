"""Logs of any robot as LeRobot v3 sets: a row holds what the log holds of its tick, and what is unfit is named."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dual_system.data.errors import DatasetError
from dual_system.data.export import ExportOptions, export, main
from dual_system.data.lerobot_folder import LeRobotFolder
from dual_system.data.recorded import joined, recording_of
from dual_system.data.recording import RecordingWriter
from protocol import images
from protocol import messages as m
from protocol.mcap_log import EpisodeRecord, read_log
from sim_client.robot_file import read_robot

ROBOTS = Path(__file__).parents[2] / "examples/robots"
SCRIPT = Path(__file__).parents[1] / "peers/lerobot_folders.py"
NAMES = ("six_axes", "two_arms", "arm_on_base")
COLUMNS = ("observation.state", "action", "level", "is_rendered", "language_persistent", "language_events")


def robot_of(name: str) -> m.Robot:
    found = read_robot(ROBOTS / f"{name}.toml")
    return found.describe(((found.robot.state_low + found.robot.state_high) / 2).astype(np.float32), (48, 64))


@pytest.fixture(scope="module")
def played(lockstep: Callable[..., Any], timing: Callable[..., m.Schedule]) -> Callable[..., Any]:
    """An episode of a robot in lockstep, in which PONDER writes with its first, second and last query."""

    def play(name: str, num_ticks: int = 40, seed: int = 3) -> Any:
        robot = robot_of(name)
        episode = lockstep(timing(control_hz=robot.control_hz), num_ticks, seed=seed, robot=robot, has_images=True)
        queries = episode.of(m.Query)
        for query in (queries[0], queries[1], queries[-1]):
            subgoal = m.Subgoal(
                kind=m.SubgoalKind.SUBGOAL, text=f"reach {query.query}", tick=query.tick, query=query.query
            )
            episode.say(subgoal, query.source_ns, proc="ponder")
        return episode

    return play


@pytest.fixture(scope="module")
def record(played: Any, tmp_path_factory: pytest.TempPathFactory) -> EpisodeRecord:
    return read_log(played("six_axes").save(tmp_path_factory.mktemp("log") / "a.mcap"))


def saved(episode: Any, path: Path, **options: Any) -> tuple[Path, EpisodeRecord]:
    return path, read_log(episode.save(path, **options))


@pytest.mark.parametrize("pixels", ["exact", "jpeg"])
@pytest.mark.parametrize("name", NAMES)
def test_a_row_holds_what_the_log_holds_of_its_tick(name: str, pixels: str, played: Any, tmp_path: Path) -> None:
    episode = played(name)
    log, record = saved(episode, tmp_path / "a b ü.mcap", pixels=pixels)
    assert main([str(log), "--out", str(tmp_path / "sét"), "--no-progress"]) == 0
    robot, folder = record.info.robot, LeRobotFolder(tmp_path / "sét")
    assert (folder.fps, folder.info["robot_type"]) == (robot.control_hz, name)
    assert folder.features["action"]["names"] == [each.name for each in robot.dimensions]
    table = folder.rows(0, COLUMNS)
    seen = {each.tick: each for each in record.observations}
    state, action = (np.array(table[column].to_pylist(), np.float32) for column in COLUMNS[:2])
    np.testing.assert_array_equal(state, [seen[tick.tick].proprio for tick in record.ticks])
    np.testing.assert_array_equal(action, [tick.action for tick in record.ticks])
    assert table["level"].to_pylist() == [tick.level.name.lower() for tick in record.ticks]
    assert table["is_rendered"].to_pylist() == [True] * len(record.ticks)
    (listed,) = folder.listed
    assert (listed["stream_sha256"], listed["texts_by"]) == (record.result.stream_sha256, "ponder")  # type: ignore[union-attr]
    sent = {each.tick: [images.unpack(image) for image in each.images] for each in episode.of(m.Observation)}
    for camera, camera_name in enumerate(robot.cameras):
        shown = folder.frames(0, f"observation.images.{camera_name}", [0, 7, 39])
        for tick, picture in zip((0, 7, 39), shown, strict=True):
            of_its_tick, of_the_next = (
                np.abs(picture - sent[at][camera].astype(float)).mean() for at in (tick, tick + 1)
            )
            assert of_its_tick < 8
            assert of_its_tick < of_the_next


@pytest.mark.parametrize("name", NAMES)
def test_subgoals_are_in_force_from_the_tick_at_which_they_were_ready(name: str, played: Any, tmp_path: Path) -> None:
    log, record = saved(played(name, 80), tmp_path / "a.mcap")
    export(ExportOptions(files=(log,), out=tmp_path / "set", progress=False))
    table, hz = LeRobotFolder(tmp_path / "set").rows(0, COLUMNS), record.info.robot.control_hz
    told = table["language_persistent"].to_pylist()
    assert all(each == told[0] for each in told)
    assert table["language_events"].to_pylist() == [[]] * len(told)
    ready_ns = {each.index: each.ready_ns for each in record.stamps if each.kind == m.StampKind.COGNITION}
    expected = []
    for each in record.subgoals:
        if each.query in ready_ns:
            ticks = [tick.tick for tick in record.ticks if tick.deadline_ns >= ready_ns[each.query]]
            expected += [("assistant", "subtask", each.text, np.float32(ticks[0] / hz))] if ticks else []
    assert [(row["role"], row["style"], row["content"], row["timestamp"]) for row in told[0]] == expected
    assert len(expected) >= 2
    assert expected[1][3] * hz > record.subgoals[1].tick, "later than at the tick that was asked about"


def test_several_logs_become_one_set_and_one_of_another_robot_is_named(played: Any, tmp_path: Path) -> None:
    logs = [saved(played("six_axes", 30 + seed, seed), tmp_path / f"{seed}.mcap")[0] for seed in (3, 4)]
    other, _ = saved(played("arm_on_base"), tmp_path / "other.mcap")
    assert export(ExportOptions(files=tuple(logs), out=tmp_path / "set", progress=False)) == (2, [])
    folder = LeRobotFolder(tmp_path / "set")
    assert [each["length"] for each in folder.listed] == [33, 34]
    assert folder.rows(1, ["action"]).num_rows == 34
    options = ExportOptions(files=(*logs, other), out=tmp_path / "mixed", progress=False)
    with pytest.raises(DatasetError, match=r"other\.mcap: robot: expected six_axes .* came arm_on_base"):
        export(options)
    written, left_out = export(replace(options, out=tmp_path / "left", unfit="leave-out"))
    assert (written, len(left_out)) == (2, 1)


def test_cut_holed_and_false_logs_are_named_with_the_reason(
    played: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    episode = played("six_axes")
    fine, _ = saved(episode, tmp_path / "fine.mcap")
    cut, false, holed = (tmp_path / f"{name}.mcap" for name in ("cut", "false", "holed"))
    cut.write_bytes(fine.read_bytes()[: fine.stat().st_size * 2 // 3])
    at = next(place for place, (each, _) in enumerate(episode.said) if isinstance(each, m.Tick) and each.tick == 20)
    tick, wall_ns = episode.said[at]
    moved = (replace(tick, action=tick.action + 1), wall_ns)
    replace(episode, said=[*episode.said[:at], moved, *episode.said[at + 1 :]]).save(false)
    silent = range(20, 21 + episode.info.robot.control_hz // 2)  # longer than half a second
    seen = [pair for pair in episode.said if not (isinstance(pair[0], m.Observation) and pair[0].tick in silent)]
    replace(episode, said=seen).save(holed)
    lacks = rf"lacks the observation, and any in the {silent[-1] - 20} ticks before, of ticks \[{silent[-1]}\] of 40"
    for log, why in ((cut, "cut"), (false, r"does not agree .* Tick 20"), (holed, lacks)):
        with pytest.raises(DatasetError, match=rf"{log.name}: .*{why}"):
            export(ExportOptions(files=(fine, log), out=tmp_path / f"{log.stem}-set", progress=False))
    logs = [str(each) for each in (cut, fine, false, holed)]
    assert main([*logs, "--out", str(tmp_path / "set"), "--unfit", "leave-out", "--no-progress"]) == 0
    told = capsys.readouterr()
    assert told.out == f"1 of 4 episodes in {tmp_path / 'set'}\n"
    named = [line.partition(".mcap")[0].rpartition("/")[2] for line in told.err.splitlines()]
    assert named == ["cut", "false", "holed"]


def test_a_missed_tick_repeats_the_command_and_a_missing_picture_the_picture(played: Any, tmp_path: Path) -> None:
    log, record = saved(played("six_axes"), tmp_path / "a.mcap")
    record.ticks[5] = replace(record.ticks[5], level=m.Level.SKIPPED, action=np.zeros(0, np.float32))
    record.observations[9] = replace(record.observations[9], images=())
    writer = RecordingWriter(tmp_path / "set")
    writer.add(recording_of(log, record))
    writer.finish()
    folder = LeRobotFolder(tmp_path / "set")
    table = folder.rows(0, COLUMNS)
    assert table["action"][5] == table["action"][4] != table["action"][6]
    assert table["level"][5].as_py() == "skipped"
    assert [row for row, own in enumerate(table["is_rendered"].to_pylist()) if not own] == [9]
    shown = folder.frames(0, "observation.images.front", [8, 9, 10]).astype(float)
    assert np.abs(shown[1] - shown[0]).mean() < 1 < np.abs(shown[2] - shown[0]).mean()


@given(unseen=st.sets(st.integers(0, 39)) | st.sampled_from([set(range(9, 19)), set(range(9, 20))]), most=st.just(10))
@example(unseen={12, 15, 39}, most=10)
@example(unseen={1}, most=0)
def test_a_tick_that_was_not_observed_has_the_newest_observation_before_it_or_the_log_is_refused(
    record: EpisodeRecord, unseen: set[int], most: int
) -> None:
    holed = replace(record, observations=[each for each in record.observations if each.tick not in unseen])
    newest = [max((each for each in range(tick + 1) if each not in unseen), default=None) for tick in range(40)]
    if all(of is not None and tick - of <= most for tick, of in enumerate(newest)):
        observations, ticks = joined(Path("a.mcap"), holed, most_held_ticks=most)
        assert [each.tick for each in observations] == newest
        assert [each.tick for each in ticks] == list(range(40))
    else:
        with pytest.raises(DatasetError, match=r"a\.mcap: the log lacks the observation.* of ticks .* of 40"):
            joined(Path("a.mcap"), holed, most_held_ticks=most)


def test_a_tick_without_an_account_is_refused_by_that_name(record: EpisodeRecord) -> None:
    holed = replace(record, ticks=[each for each in record.ticks if each.tick != 7])
    with pytest.raises(DatasetError, match=r"lacks the account of ticks \[7\] of 40"):
        joined(Path("a.mcap"), holed, most_held_ticks=10)


def test_a_log_of_a_late_robot_has_rows_of_what_was_seen_before(played: Any, tmp_path: Path) -> None:
    episode, late = played("six_axes"), (12, 15, 16)
    kept = [pair for pair in episode.said if not (isinstance(pair[0], m.Observation) and pair[0].tick in late)]
    log, record = saved(replace(episode, said=kept), tmp_path / "late.mcap")
    assert export(ExportOptions(files=(log,), out=tmp_path / "set", progress=False)) == (1, [])
    table = LeRobotFolder(tmp_path / "set").rows(0, COLUMNS)
    state, action = (np.array(table[column].to_pylist(), np.float32) for column in COLUMNS[:2])
    seen = {each.tick: each.proprio for each in record.observations}
    newest = [{12: 11, 15: 14, 16: 14}.get(tick, tick) for tick in range(40)]
    np.testing.assert_array_equal(state, [seen[tick] for tick in newest])
    np.testing.assert_array_equal(action, [each.action for each in record.ticks])
    assert [row for row, own in enumerate(table["is_rendered"].to_pylist()) if not own] == [*late]


@pytest.mark.peers
@pytest.mark.parametrize("name", NAMES)
def test_lerobot_reads_every_row(name: str, played: Any, tmp_path: Path) -> None:
    python = os.environ.get("LEROBOT_PYTHON")
    if not python:
        pytest.skip("LEROBOT_PYTHON is not set; make peers sets it")
    log, record = saved(played(name), tmp_path / "a.mcap")
    export(ExportOptions(files=(log,), out=tmp_path / "set", progress=False))
    outside = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"HF_HUB_OFFLINE": "1"}
    command = [python, str(SCRIPT), "rows", str(tmp_path / "set")]
    done = subprocess.run(command, capture_output=True, text=True, env=outside, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.splitlines()[-1])
    seen = {each.tick: each for each in record.observations}
    assert (found["fps"], found["robot"]) == (record.info.robot.control_hz, name)
    state, action = (np.array(found[column], np.float32) for column in ("state", "action"))
    np.testing.assert_array_equal(state, [seen[each.tick].proprio for each in record.ticks])
    np.testing.assert_array_equal(action, [each.action for each in record.ticks])
    assert found["level"] == [each.level.name.lower() for each in record.ticks]
    assert set(found["task"]) == {record.info.instruction}
    assert {row["style"] for row in found["persistent"][0]} == {"subtask"}
    assert found["events"] == [[]] * len(record.ticks)
    ours = LeRobotFolder(tmp_path / "set")
    for key, pictures in found["pictures"].items():
        np.testing.assert_allclose(np.array(pictures), ours.frames(0, key, [0, 1, 2]), atol=1)
