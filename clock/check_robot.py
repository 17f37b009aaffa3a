"""Checks what a robot relies on at a stop, from its description and the log alone, without the rules of playing.

``check_ticks`` derives every command by the clock service's own rules; if those were wrong, it would agree with them.
These are laws over the commands as they were sent, whatever made them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from clock.check_findings import Disagreement, compare
from clock.dimensions import dimensions_of
from clock.limits import why_not_obey
from clock.sight import NEVER, unfit
from protocol.mcap_log import EpisodeRecord
from protocol.messages import EPISODE_CLOCK, Floats, Level, Tick

_PLAYS = (Level.PLAY, Level.STALE)


def check_robot(record: EpisodeRecord) -> Iterator[Disagreement]:
    """Yields commands that break the robot's limits, or move what a stop must leave alone."""
    robot = record.info.robot
    dims, last, last_tick, row_tick = dimensions_of(robot), robot.initial_command, -1, -1
    engaged = {event.tick for event in record.events if event.name == "engaged"}
    shown_in = _shown_in(record)
    for index, tick in enumerate(record.ticks):
        yield from _check_ages(record, index, tick, shown_in)
        if tick.level == Level.SKIPPED:
            continue
        state = tick.state if len(tick.state) else None
        may_jump = any(last_tick < at <= tick.tick for at in engaged)
        if why_not := why_not_obey(tick.action, last, robot, state if may_jump else None, tick.tick - last_tick):
            yield from compare("Tick", index, action=(why_not, tick.action.tolist()))
        if tick.level in _PLAYS:
            row_tick = tick.tick
            sight = unfit(robot, tick.picture_age_ns, tick.picture_still_ns)
            if sight:
                yield from compare("Tick", index, level=(f"HOLD, because of {sight.name}", tick.level.name))
        else:
            yield from _check_rest(index, tick, last, row_tick, record)
            if tick.level == Level.HOLD and not may_jump:
                held = np.delete(last, dims.velocities), np.delete(tick.action, dims.velocities)
                yield from compare("Tick", index, held=held)
        last, last_tick = tick.action, tick.tick


def _check_rest(index: int, tick: Tick, last: Floats, row_tick: int, record: EpisodeRecord) -> Iterator[Disagreement]:
    """Without a row grippers stay, and velocities are zero in time."""
    robot = record.info.robot
    dims = dimensions_of(robot)
    yield from compare("Tick", index, grippers=(last[dims.is_gripper_A], tick.action[dims.is_gripper_A]))
    rates = tick.action[dims.velocities]
    if len(rates) and tick.tick - row_tick >= robot.stop_ticks and rates.any():
        expected = f"0, {robot.stop_ticks} ticks after the row of tick {row_tick}"
        yield from compare("Tick", index, velocities=(expected, rates.tolist()))


def _check_ages(
    record: EpisodeRecord, index: int, tick: Tick, shown_in: dict[tuple[str, int], int]
) -> Iterator[Disagreement]:
    """A picture's age is that of a picture which had come by then; on another host's clock nobody can say."""
    for camera, age_ns in zip(record.info.robot.cameras, tick.picture_age_ns, strict=False):
        if not shown_in or age_ns in (NEVER, 0):
            continue
        first_tick = shown_in.get((camera, tick.deadline_ns - age_ns))
        if first_tick is None or first_tick > tick.observation_tick:
            expected = f"that of a picture of {camera} up to tick {tick.observation_tick}"
            yield from compare("Tick", index, picture_age_ns=(expected, age_ns))


def _shown_in(record: EpisodeRecord) -> dict[tuple[str, int], int]:
    """By camera and instant [episode time]: the tick of the first observation with that picture."""
    found: dict[tuple[str, int], int] = {}
    for observation in record.observations:
        if observation.header.clock_id != EPISODE_CLOCK:
            return {}
        instants = observation.captured_ns or (observation.source_ns,) * len(observation.images)
        for image, at_ns in zip(observation.images, instants, strict=True):
            found.setdefault((image.camera, at_ns), observation.tick)
    return found
