"""The arithmetic of the gateway: PONDER's frames of a video, and the forecast of commands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clock.limits import within_limits
from dual_system.models.ponder.demo_sampling import DemoSampling
from protocol.messages import Action, ActionChunk, Floats, Level, Robot
from sim_client.gateway.exchange import Frames


def sampled(video: Sequence[Frames], control_hz: int, sampling: DemoSampling) -> Sequence[Frames]:
    """The frames of a video at the control rate that PONDER reads."""
    return [video[index] for index in sampling.indices(len(video), control_hz)]


def ahead(command: Action, chunk: ActionChunk | None, robot: Robot, num_rows: int) -> tuple[Floats, tuple[Level, ...]]:
    """The commands from a tick on unless a new chunk comes: (num_rows, action_dim), and their rungs.

    First the command itself, then ``chunk``'s rows for the following ticks, within the robot's limits, then the last of
    them held. For a robot that is not playing, the command is repeated.
    """
    rows, levels = [command.values], [command.level]
    is_playing = command.level in (Level.PLAY, Level.STALE)
    while len(rows) < num_rows:
        due_tick = command.tick + len(rows)
        row: Floats | None = None
        if chunk is not None and is_playing and 0 <= due_tick - chunk.t_row0 < chunk.horizon:
            row, _ = within_limits(chunk.rows_NA[due_tick - chunk.t_row0], rows[-1], robot, None)
        levels.append(Level.HOLD if is_playing and row is None else command.level)
        rows.append(rows[-1] if row is None else row)
    return np.stack(rows), tuple(levels)
