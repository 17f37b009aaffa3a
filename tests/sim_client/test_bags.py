"""rosbag2 recordings on a robot's control grid: of every topic the newest message that is not later."""

from __future__ import annotations

import os
import re
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from dual_system.data.lerobot_folder import LeRobotFolder
from sim_client.bags import main

ROBOT = Path(__file__).parents[2] / "examples/robots/six_axes.toml"
SCRIPT = Path(__file__).parents[1] / "peers/ros_bags.py"
MAPPING = """
instruction = "pick it up"
cameras = {front = "/front", wrist = "/wrist"}
state = {topic = "/joint_states"}
action = {topic = "/commands"}
"""
NAMES = ("gripper", "wrist_yaw", "wrist_roll", "wrist_flex", "elbow_flex", "shoulder_lift", "shoulder_pan")
HZ, BEGIN_NS, MS = 30, 1_700_000_000_000_000_000, 1_000_000
Said = list[tuple[int, str, str, bytes]]  # instant, topic, type, message


def cdr(*parts: Any) -> bytes:
    """Little endian: ints as uint32, texts, doubles as arrays, bytes as they are with their length."""
    found = b""
    for part in parts:
        found += b"\0" * (-len(found) % 4)
        if isinstance(part, np.ndarray):
            found += struct.pack("<I", len(part))
            found += b"\0" * (-len(found) % 8 if len(part) else 0) + part.astype("<f8").tobytes()
            continue
        if isinstance(part, int):
            found += struct.pack("<I", part)
            continue
        data = part.encode() + b"\0" if isinstance(part, str) else part
        found += struct.pack("<I", len(data)) + data
    return b"\0\1\0\0" + found


def stamp(at_ns: int) -> tuple[int, int, str]:
    return at_ns // 10**9, at_ns % 10**9, "base"


def joints(at_ns: int, value: float, names: tuple[str, ...] = NAMES) -> bytes:
    none = np.zeros(0)
    return cdr(*stamp(at_ns), len(names), *names, value + 0.001 * np.arange(len(names)), none, none)


def picture(at_ns: int, shade: int) -> bytes:
    head = cdr(*stamp(at_ns), 16, 16, "mono8")  # a uint8 follows, for which the text leaves room
    return head + b"\0" * (-(len(head) - 4 + 1) % 4 + 1) + struct.pack("<II", 16, 256) + bytes([shade]) * 256


def recorded(num_ms: int = 1000) -> Said:
    """States every 10 ms, commands 1 ms later, one camera every 40 ms and one every 50."""
    said: Said = []
    for at in range(0, num_ms, 10):
        at_ns = BEGIN_NS + at * MS
        said.append((at_ns, "/joint_states", "JointState", joints(at_ns, at / 1000)))
        said.append((at_ns + MS, "/commands", "JointState", joints(at_ns + MS, (at + 1) / 1000)))
    for topic, period in (("/front", 40), ("/wrist", 50)):
        for number, at in enumerate(range(0, num_ms, period)):
            said.append((BEGIN_NS + at * MS, topic, "Image", picture(BEGIN_NS + at * MS, 10 * number)))
    return sorted(said, key=lambda each: each[0])


@pytest.fixture
def imported(tmp_path: Path) -> Callable[..., int]:
    def run(said: Said, *options: str, mapping: str = MAPPING, name: str = "a bág") -> int:
        path = tmp_path / f"{name}.mcap"
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start("ros2")
            kinds = {kind: writer.register_schema(f"sensor_msgs/msg/{kind}", "ros2msg", b"") for _, _, kind, _ in said}
            channels = {topic: writer.register_channel(topic, "cdr", kinds[kind]) for _, topic, kind, _ in said}
            for number, (at_ns, topic, _, data) in enumerate(said):
                writer.add_message(channels[topic], at_ns + 2 * MS, data, at_ns + 2 * MS, number)
            writer.finish()
        (tmp_path / "map.toml").write_text(mapping)
        given = ["--robot-file", str(ROBOT), "--mapping", str(tmp_path / "map.toml"), "--out", str(tmp_path / "set")]
        return main([str(path), *given, "--no-progress", *options])

    return run


def test_each_row_shows_the_newest_that_is_not_later_and_does_the_last_command_before_the_next(
    imported: Callable[..., int], tmp_path: Path
) -> None:
    assert imported(recorded()) == 0
    folder = LeRobotFolder(tmp_path / "set")
    table = folder.rows(0, ["observation.state", "action", "is_rendered"])
    num_rows = 28  # to the last picture of a camera, at 950 ms
    assert (folder.fps, table.num_rows, folder.listed[0]["tasks"]) == (HZ, num_rows, ["pick it up"])
    begin = 1  # ms: the first command's
    row_ms = begin + np.arange(num_rows + 1) * 1000 / HZ
    names = folder.features["observation.state"]["names"]
    place = [NAMES.index(name) for name in names]
    state = np.floor(row_ms[:-1] / 10) * 10
    action = np.floor((row_ms[1:] - 1 - 1e-6) / 10) * 10 + 1
    for column, at in (("observation.state", state), ("action", action)):
        expected = at[:, None] / 1000 + 0.001 * np.array(place)
        np.testing.assert_allclose(np.array(table[column].to_pylist()), expected, atol=1e-6)
    for camera, period in (("front", 40), ("wrist", 50)):
        shown = folder.frames(0, f"observation.images.{camera}", list(range(num_rows)))[:, 8, 8, 0]
        np.testing.assert_allclose(shown, 10 * np.floor(row_ms[:-1] / period), atol=3)
    fresh = [np.diff(np.floor(row_ms[:-1] / period), prepend=-1) > 0 for period in (40, 50)]
    assert table["is_rendered"].to_pylist() == (fresh[0] & fresh[1]).tolist()


def without(said: Said, topic: str, begin_ms: int, end_ms: int) -> Said:
    return [each for each in said if each[1] != topic or not begin_ms <= (each[0] - BEGIN_NS) / MS < end_ms]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (
            lambda said: without(said, "/front", 200, 600),
            r"/front was silent for \d+ ms, expected at most 200 ms.*row 11",
        ),
        (lambda said: without(said, "/wrist", 0, 2000), r"no message on /wrist; there are /commands \(sensor_msgs/msg"),
        (
            lambda said: [*said, (BEGIN_NS, "/joint_states", "JointState", joints(BEGIN_NS, 0.0))],
            "before the message before",
        ),
        (lambda said: [(at, topic, kind, data[:40]) for at, topic, kind, data in said], "message 0 on /.*ends at byte"),
        (
            lambda said: [
                (at, topic, kind, joints(at, 0.0, NAMES[1:]) if kind == "JointState" else data)
                for at, topic, kind, data in said
            ],
            "no joint gripper; it has wrist_yaw",
        ),
        (
            lambda said: [
                (at, topic, kind, joints(at, 90.0) if kind == "JointState" else data) for at, topic, kind, data in said
            ],
            "in row 0; the robot's file says .* another unit",
        ),
    ],
)
def test_what_does_not_fit_is_named_with_numbers(
    change: Callable[[Said], Said], why: str, imported: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert imported(change(recorded())) == 2
    told = capsys.readouterr().err
    assert len(told.splitlines()) == 1
    assert re.search(why, told), told


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ('wrist = "/wrist"', "", "cameras: expected"),
        ("/commands", "/front", "expected sensor_msgs/msg/JointState, came sensor_msgs/msg/Image"),
        ('{topic = "/commands"}', '{topic = "/commands", names = ["a"]}', "names of 7 joints"),
        ("instruction", "told", "instruction"),
        ("[", "[[", "map.toml"),
    ],
)
def test_a_mapping_that_does_not_fit_is_a_sentence(
    old: str, new: str, why: str, imported: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    text = MAPPING.replace(", " + old, new) if not new and ", " + old in MAPPING else MAPPING.replace(old, new)
    if old == "[":
        text = "cameras = [[" + MAPPING
    assert imported(recorded(200), mapping=text) == 2
    assert why in capsys.readouterr().err


def test_a_bag_that_is_cut_is_left_out_where_that_is_asked_for(
    imported: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert imported(recorded(400), name="whole") == 0
    whole = tmp_path / "whole.mcap"
    (tmp_path / "cut.mcap").write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    given = ["--robot-file", str(ROBOT), "--mapping", str(tmp_path / "map.toml"), "--no-progress"]
    bags = [str(tmp_path / "cut.mcap"), str(whole)]
    assert main([*bags, *given, "--out", str(tmp_path / "no")]) == 2
    assert main([*bags, *given, "--out", str(tmp_path / "left"), "--unfit", "leave-out"]) == 0
    told = capsys.readouterr()
    assert "left out: " in told.err
    assert "cut.mcap" in told.err
    assert len(LeRobotFolder(tmp_path / "left").listed) == 1


@pytest.mark.peers
def test_a_bag_that_rosbags_wrote(tmp_path: Path) -> None:
    python = os.environ.get("ROSBAGS_PYTHON")
    if not python:
        pytest.skip("ROSBAGS_PYTHON is not set; make peers sets it")
    outside = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run([python, str(SCRIPT), str(tmp_path / "bag")], env=outside, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    mapping = MAPPING.replace('"/front"', '"/front/image_raw"').replace('"/wrist"', '"/wrist/image/compressed"')
    (tmp_path / "map.toml").write_text(mapping)
    given = ["--robot-file", str(ROBOT), "--mapping", str(tmp_path / "map.toml"), "--out", str(tmp_path / "set")]
    assert main([str(tmp_path / "bag"), *given, "--no-progress"]) == 0
    folder = LeRobotFolder(tmp_path / "set")
    table = folder.rows(0, ["observation.state", "action"])
    state, action = (np.array(table[column].to_pylist()) for column in ("observation.state", "action"))
    place = np.array([NAMES.index(name) for name in folder.features["action"]["names"]])
    at_s = 0.001 + np.arange(len(state) + 1) / HZ
    np.testing.assert_allclose(state, 0.001 * place + 0.1 * (np.floor(at_s[:-1] * 100) / 100)[:, None], atol=1e-5)
    commanded = np.floor((at_s[1:] - 0.001 - 1e-9) * 100) / 100
    np.testing.assert_allclose(action, 0.5 + 0.001 * place + 0.1 * commanded[:, None], atol=1e-5)
    front, wrist = (
        folder.frames(0, f"observation.images.{name}", [0, 10, 20])[:, 24, 32] for name in ("front", "wrist")
    )
    shown = np.floor((at_s[[0, 10, 20]]) * 30 + 1e-6)
    np.testing.assert_allclose(front[:, 0], 4 * shown, atol=6)
    np.testing.assert_allclose(front[:, 2], 200, atol=6)
    np.testing.assert_allclose(wrist[:, 1], 255 - 4 * shown, atol=6)
