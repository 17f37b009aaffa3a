"""The arithmetic of the gateway: PONDER's frames of a video, and the forecast of commands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clock.dimensions import coasting
from clock.limits import within_limits
from clock.playback import Chunk, row_of
from dual_system.models.ponder.demo_sampling import DemoSampling
from protocol.messages import Action, ActionChunk, Floats, Level, Robot
from sim_client.gateway.exchange import Frames


def sampled(video: Sequence[Frames], video_hz: int, sampling: DemoSampling) -> Sequence[Frames]:
    """The frames of a video that PONDER reads."""
    return [video[index] for index in sampling.indices(len(video), video_hz)]


def ahead(command: Action, chunk: ActionChunk | None, robot: Robot, num_rows: int) -> tuple[Floats, tuple[Level, ...]]:
    """The commands from a tick on unless a new chunk comes: (num_rows, action_dim), and their rungs.

    First the command itself, then ``chunk``'s rows for the following ticks, within the robot's limits, then the last of
    them held, with velocities on their way to zero. For a robot that is not playing, the command is repeated.
    """
    rows, levels = [command.values], [command.level]
    is_playing = command.level in (Level.PLAY, Level.STALE)
    played = Chunk.of(chunk, robot) if chunk is not None and is_playing else None
    last_row, idle_ticks = command.values, 0
    while len(rows) < num_rows:
        due_tick = command.tick + len(rows)
        row: Floats | None = None
        if played is not None and (at := row_of(played, due_tick)) is not None:
            row, _ = within_limits(played.rows_NA[at], rows[-1], robot, None)
        levels.append(Level.HOLD if is_playing and row is None else command.level)
        last_row, idle_ticks = (last_row, idle_ticks + 1) if row is None else (row, 0)
        rows.append(coasting(rows[-1], last_row, robot, idle_ticks) if row is None else row)
    return np.stack(rows), tuple(levels)
