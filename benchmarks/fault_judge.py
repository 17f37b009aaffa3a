"""What a fault left behind: is each log whole or cut for a reason that is named, and did anything move unbidden?

Motion is judged without the clock's own rules: a played command comes from the row that its chunk has for this tick,
every other one is the last command again, or lies towards the measured joints.
"""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from clock.check import main as pp_check
from clock.check_gaps import before_gaps
from protocol import messages as m
from protocol.errors import FileError
from protocol.mcap_log import EpisodeRecord, read_log

_TOLERANCE = 1e-5
_SLACK_RAD = 0.1  # a deceleration ends where the arm was measured when it began; it has moved since


def verdict(path: Path) -> tuple[str, str]:
    """("whole", "") or ("cut", why) if ``pp-check`` agrees with a log; ("wrong", what it says) if not."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        pp_check(["--json", str(path)])
    found = json.loads(said.getvalue())
    if "error" in found:
        return "wrong", f"unreadable: {found['error']}"
    if not found["agrees"]:
        return "wrong", f"disagrees: {found['disagreement']}, {found['dropped_messages']} messages dropped"
    return ("cut", found["unfinished"]) if found["unfinished"] else ("whole", "")


def unbidden_in(path: Path) -> list[str]:
    """``unbidden`` of a log; an unreadable one has nothing to tell."""
    try:
        record, _ = before_gaps(read_log(path))
    except (OSError, FileError):
        return []  # the verdict has it
    return list(unbidden(record))


def unbidden(record: EpisodeRecord) -> Iterator[str]:
    """Yields sentences about commands that are neither from a chunk, nor a hold, nor on the way to a stop."""
    robot, last = record.info.robot, record.info.robot.initial_command
    chunks = {chunk.invocation: chunk for chunk in reversed(record.chunks)}
    largest = np.where(robot.max_step > 0, robot.max_step, np.inf) + _TOLERANCE
    sent = {action.tick: action.values for action in record.actions}
    engaged = sorted(event.tick for event in record.events if event.name == "engaged")
    for tick in record.ticks:
        if tick.level == m.Level.SKIPPED:
            if tick.tick in sent:
                yield f"tick {tick.tick} was skipped, and commanded"
            continue
        command = tick.action
        if engaged and engaged[0] <= tick.tick:  # motion begins where the arm was measured
            engaged.pop(0)
            arm = min(len(tick.state), len(last) - 1)
            last = np.concatenate([tick.state[:arm], last[arm:]])
        if tick.tick in sent and sent[tick.tick].tobytes() != command.tobytes():
            yield f"tick {tick.tick}: the command sent is not the one in its account"
        if not ((robot.command_low <= command) & (command <= robot.command_high)).all():
            yield f"tick {tick.tick}: out of the joint limits"
        if (np.abs(command - last) > largest).any():
            yield f"tick {tick.tick}: farther than a step"
        if why_not := _groundless(tick, last, chunks.get(tick.invocation) if tick.invocation is not None else None):
            yield f"tick {tick.tick}: {why_not}"
        last = command


def _groundless(tick: m.Tick, last: m.Floats, chunk: m.ActionChunk | None) -> str:
    """Why a command comes from nowhere; "" if it does not."""
    if tick.level == m.Level.HOLD:
        return "" if tick.action.tobytes() == last.tobytes() else "a hold is not the last command"
    if tick.level in (m.Level.PLAY, m.Level.STALE):
        if chunk is None:
            return f"chunk {tick.invocation} is not in the log"
        row = tick.tick - chunk.t_row0
        if not 0 <= row < chunk.horizon or chunk.rows_NA[row].tobytes() != tick.raw_row.tobytes():
            return f"not row {row} of chunk {tick.invocation}"
        is_changed = tick.action.tobytes() != tick.raw_row.tobytes()
        return "the row was changed, and no limit is named" if is_changed and not tick.limits_hit else ""
    # decelerating or stopped: each joint goes towards where it was measured in this episode, or stays
    arm = min(len(tick.state), len(tick.action) - 1)
    low = np.minimum(last[:arm], tick.state[:arm]) - _SLACK_RAD
    high = np.maximum(last[:arm], tick.state[:arm]) + _SLACK_RAD
    if ((tick.action[:arm] < low) | (tick.action[:arm] > high)).any():
        return "neither the last command nor towards the measured joints"
    return "" if tick.action[arm:].tobytes() == last[arm:].tobytes() else "the gripper moved on the way to a stop"


def tracebacks(text: str) -> int:
    """Python's and Rust's."""
    return text.count("Traceback (most recent call last)") + text.count("panicked at")
