"""A rosbag2 recording in MCAP as a `Recording`: topics by a mapping file, on a robot's control grid.

Row k is seen at ``begin + k / control_hz``: of every topic the newest message that is not later. Its action is the last
command before the next row, for that is what followed what was seen. Nothing is interpolated, and a topic that was
silent for longer than ``max_gap_ms`` is refused, with the numbers.
"""

# N rows, K messages of a topic, P numbers of the state, A of the command

from __future__ import annotations

import re
import struct
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dual_system.data import ros_messages as ros
from dual_system.data.errors import DatasetError
from dual_system.data.recording import Recording, Seen, action_names, state_names
from dual_system.models.config_json import from_json
from protocol import files
from protocol import messages as m
from protocol.errors import FileError
from protocol.mcap_records import Records

KIND = "rosbag2 recording in MCAP"
NS_PER_MS, NS_PER_S = 1_000_000, 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """A camera of the robot's file, and its topic of sensor_msgs/Image or CompressedImage."""

    name: str
    topic: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Joints:
    """A topic of sensor_msgs/JointState."""

    topic: str
    names: tuple[str, ...] = ()
    """Its joints in the order of the robot's file; left out: they are called as the file's dimensions are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BagMapping:
    """Which topics of a bag are what."""

    cameras: tuple[Camera, ...] = ()
    state: Joints
    action: Joints
    """Commands: positions, and of dimensions that are velocities the velocities."""
    instruction: str
    """What the robot was to do: LeRobot's task."""
    time: Literal["header", "log"] = "header"
    """Instant of a message: its header's stamp, or when the recorder had it."""
    max_gap_ms: float = 200.0
    """Longest age of a message that a row shows."""


def read_bag_mapping(path: Path) -> BagMapping:
    """Reads a TOML file, whose ``[cameras]`` has a line ``name = "topic"`` for each.

    Raises:
        DatasetError: the file is no TOML, lacks a field, or has one that is unknown or does not fit.
        OSError: it cannot be read.
    """
    text = files.read_text(path, "mapping file")
    try:
        given = tomllib.loads(text)
        if isinstance(cameras := given.get("cameras"), dict):
            given["cameras"] = [{"name": name, "topic": topic} for name, topic in cameras.items()]
        return from_json(BagMapping, given, str(path))
    except (ValueError, TypeError) as error:  # tomllib's errors are ValueErrors
        raise DatasetError(f"{path}: {error}" if str(path) not in str(error) else str(error)) from None


def recording_of_bag(path: Path, mapping: BagMapping, robot: m.Robot) -> Recording:
    """A bag's episode on the robot's control grid.

    Args:
        path: an .mcap file, or rosbag2's folder with one or several, which follow each other.
        robot: its file's; names, order and rate are the robot's.

    Raises:
        DatasetError: a topic, a joint or a stretch of time is missing, or a number is none that the robot can have.
        FileError: a file is cut, or no MCAP.
    """
    if (names := sorted(each.name for each in mapping.cameras)) != sorted(robot.cameras):
        raise DatasetError(f"cameras: expected {sorted(robot.cameras)} as {robot.name} has, came {names}")
    paths = parts_of(path)
    tracks = _tracks(paths, mapping, robot)
    begin_ns = max(track.times_ns[0] for track in tracks)
    end_ns = min(track.times_ns[-1] for track in tracks)
    hz = robot.control_hz
    num_rows = (end_ns - begin_ns) * hz // NS_PER_S
    if num_rows < 1:
        raise DatasetError(f"{path}: its topics overlap for {(end_ns - begin_ns) / 1e9:.3f} s: no row at {hz} Hz")
    grid_ns = begin_ns + np.arange(num_rows + 1) * NS_PER_S // hz
    state, action, *cameras = tracks
    state_N, *shown_N = (_newest(path, track, grid_ns[:-1], mapping) for track in (state, *cameras))
    action_N = _newest(path, action, grid_ns[1:] - 1, mapping)
    state_NP, action_NA = np.stack(state.rows)[state_N], np.stack(action.rows)[action_N]
    _check_range(path, "state", state_names(robot), state_NP, robot.state_low, robot.state_high)
    _check_range(path, "action", action_names(robot), action_NA, robot.command_low, robot.command_high)
    return Recording(
        name=str(path),
        robot=robot,
        control_hz=hz,
        instruction=mapping.instruction,
        state_NP=state_NP,
        action_NA=action_NA,
        level=("play",) * int(num_rows),
        spoken=[],
        seen=_seen(paths, cameras, shown_N),
        about={"episode": path.stem, "task": path.stem, "origin": "rosbag2", "begin_unix_ns": int(begin_ns)},
    )


def parts_of(path: Path) -> list[Path]:
    """The files of a bag, in order. Raises DatasetError if there is none that is MCAP."""
    if not path.is_dir():
        return [path]
    found = sorted(path.glob("*.mcap"), key=lambda each: [int(number) for number in re.findall(r"\d+", each.stem)[-1:]])
    if not found:
        others = sorted(each.name for each in path.iterdir())[:5]
        raise DatasetError(f"{path} holds no .mcap but {others}; ros2 bag convert makes MCAP of a .db3")
    return found


@dataclass(slots=True)
class _Track:
    """A topic's messages in the order of the file: their instants, and the numbers of joints."""

    role: str
    topic: str
    schemas: tuple[str, ...]
    joints: tuple[str, ...] = ()
    is_velocity: tuple[bool, ...] = ()
    times_ns: list[int] = field(default_factory=list)
    rows: list[m.Floats] = field(default_factory=list)

    def take(self, schema: str, data: bytes, log_ns: int, time: str) -> None:
        """Raises ValueError if the message is damaged, of another type, lacks a joint, or runs back in time."""
        if schema not in self.schemas:
            raise ValueError(f"expected {' or '.join(self.schemas)}, came {schema or 'no schema'}")
        at_ns = ros.stamp_of(data) if time == "header" else log_ns
        if at_ns <= 0:
            raise ValueError('its header has no stamp; time = "log" takes the recorder\'s')
        if self.times_ns and at_ns < self.times_ns[-1]:
            raise ValueError(f"it is {(self.times_ns[-1] - at_ns) / 1e6:.1f} ms before the message before it")
        if self.joints:
            self.rows.append(self._row(ros.joints_of(data)))
        self.times_ns.append(at_ns)

    def _row(self, state: ros.JointState) -> m.Floats:
        place = {name: at for at, name in enumerate(state.names)}
        if missing := [name for name in self.joints if name not in place]:
            raise ValueError(f"no joint {', '.join(missing)}; it has {', '.join(state.names)}")
        kinds = {"position": state.position, "velocity": state.velocity}
        row = np.empty(len(self.joints), np.float32)
        for dim, (name, is_velocity) in enumerate(zip(self.joints, self.is_velocity, strict=True)):
            kind = "velocity" if is_velocity else "position"
            if not len(kinds[kind]):
                raise ValueError(f"no {kind} of {name}")
            row[dim] = kinds[kind][place[name]]
        if not np.isfinite(row).all():
            raise ValueError("numbers that are NaN or infinite")
        return row


def _tracks(paths: list[Path], mapping: BagMapping, robot: m.Robot) -> list[_Track]:
    """State, action and cameras with all their messages, of which there is one at least."""
    measured = state_names(robot)
    is_velocity = tuple(each.kind == m.DimensionKind.VELOCITY for each in robot.dimensions)
    tracks = [
        _joints("state", mapping.state, measured, (False,) * len(measured)),
        _joints("action", mapping.action, action_names(robot), is_velocity or (False,) * robot.action_dim),
        *(_Track(f"camera {each.name}", each.topic, (ros.IMAGE, ros.COMPRESSED)) for each in mapping.cameras),
    ]
    there: dict[str, str] = {}
    for path, schema, topic, message in _messages(paths):
        there[topic] = schema
        for track in tracks:
            if track.topic == topic:
                with _at(path, track, len(track.times_ns)):
                    track.take(schema, message.data, message.log_time, mapping.time)
    for track in tracks:
        if not track.times_ns:
            listed = ", ".join(f"{topic} ({schema})" for topic, schema in sorted(there.items()))
            raise DatasetError(f"{paths[0]}: {track.role}: no message on {track.topic}; there are {listed or 'none'}")
    return tracks


def _joints(role: str, given: Joints, ours: list[str], is_velocity: tuple[bool, ...]) -> _Track:
    if given.names and len(given.names) != len(ours):
        raise DatasetError(f"{role}: expected the names of {len(ours)} joints ({', '.join(ours)}), came {given.names}")
    return _Track(role, given.topic, (ros.JOINTS,), given.names or tuple(ours), is_velocity)


def _messages(paths: list[Path]) -> Iterator[tuple[Path, str, str, Any]]:
    """Every message with its file, schema and topic. Raises FileError if a file is no MCAP, or is cut."""
    for path in paths:
        with files.reading(path, KIND), files.open_file(path) as file:
            records = Records(file)
            for record in records:
                if records.is_message(record):
                    yield path, records.schema_of(record), records.topic_of(record), record
            if records.damage:
                raise FileError(f"{path} is cut or no {KIND}: {records.damage}")


@contextmanager
def _at(path: Path, track: _Track, number: int) -> Iterator[None]:
    try:
        yield
    except (ValueError, struct.error) as error:
        raise DatasetError(f"{path}: {track.role}: message {number} on {track.topic}: {error}") from None


def _newest(path: Path, track: _Track, at_ns: NDArray[np.int64], mapping: BagMapping) -> NDArray[np.intp]:
    """Number of the newest message that is not later than each instant. Raises DatasetError if one is too old."""
    times_ns = np.array(track.times_ns)
    found = np.searchsorted(times_ns, at_ns, side="right") - 1
    old_ns = at_ns - times_ns[found]
    if old_ns.max() > mapping.max_gap_ms * NS_PER_MS:
        row = int(np.argmax(old_ns > mapping.max_gap_ms * NS_PER_MS))
        raise DatasetError(
            f"{path}: {track.role}: {track.topic} was silent for {old_ns.max() / 1e6:.0f} ms, expected at most "
            f"{mapping.max_gap_ms:g} ms (max_gap_ms); first in row {row}, {(at_ns[row] - at_ns[0]) / 1e9:.2f} s after "
            "the first"
        )
    return found


def _check_range(path: Path, what: str, names: list[str], values: m.Floats, low: m.Floats, high: m.Floats) -> None:
    room = 1e-4 * (high - low)
    is_out = (values < low - room) | (values > high + room)
    if is_out.any():
        row, dim = map(int, np.argwhere(is_out)[0])
        raise DatasetError(
            f"{path}: {what} {names[dim]} is {values[row, dim]:g} in row {row}; the robot's file says {low[dim]:g} to "
            f"{high[dim]:g}. Is it in another unit?"
        )


def _seen(paths: list[Path], cameras: list[_Track], shown: list[NDArray[np.intp]]) -> Iterator[Seen]:
    """The pictures that rows show, each in the first row that shows it."""
    first = [dict(zip(*np.unique(places, return_index=True), strict=True)) for places in shown]
    counts = [0] * len(cameras)
    for path, schema, topic, message in _messages(paths):
        for number, camera in enumerate(cameras):
            if camera.topic != topic:
                continue
            row = first[number].get(counts[number])
            if row is not None:
                with _at(path, camera, counts[number]):
                    frame = ros.picture_of(schema, message.data)
                yield Seen(camera.role.removeprefix("camera "), int(row), frame)
            counts[number] += 1
