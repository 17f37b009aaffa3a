"""Checks the row played at every tick: deadline, chunk, seam, limits, ladder and command are derived again.

The only state carried from tick to tick is that of the rules: the last command, the ladder's rung, and the chunk
played last.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from clock.check_answers import Answers
from clock.check_findings import Disagreement, compare
from clock.commander import Commander
from clock.dimensions import dimensions_of
from clock.playback import Chunk, covering, deadline_ns, row_of, seam_policy, tick_at
from clock.residual import Due, ResidualHead, corrected
from clock.sight import unfit
from clock.timebase import NS_PER_MS
from protocol.mcap_log import EpisodeRecord
from protocol.messages import EpisodeInfo, Floats, Level, Mode, Tick

_NO_FLOATS: Floats = np.zeros(0, np.float32)


def check_deadlines(record: EpisodeRecord) -> Iterator[Disagreement]:
    """Checks that tick k, without gaps, is due k / hz after tick 0, and is never late in lockstep."""
    schedule = record.info.schedule
    for index, tick in enumerate(record.ticks):
        yield from compare("Tick", index, tick=(index, tick.tick))
        due_ns = deadline_ns(record.ticks[0].deadline_ns, index, schedule.control_hz)
        yield from compare(
            "Tick",
            index,
            deadline_ns=(due_ns, tick.deadline_ns),
            late_ns=(tick.decided_ns - tick.deadline_ns, tick.late_ns),
            late_ms=(tick.late_ns / NS_PER_MS, tick.late_ms),
        )
        if tick.late_ns < 0:
            yield from compare("Tick", index, late_ns=("0 or more", tick.late_ns))
        if schedule.mode == Mode.LOCKSTEP:
            yield from compare("Tick", index, late_ns=(0, tick.late_ns))


def check_rows(record: EpisodeRecord, answers: Answers, residual: ResidualHead | None = None) -> Iterator[Disagreement]:
    """Checks each tick's command, and that the Action sent is equal. Assumes that the deadlines agree."""
    states = _logged_states(record)
    actions = {action.tick: action for action in record.actions}
    engaged = sorted(event.tick for event in record.events if event.name == "engaged")
    playing = _Playing(record.info, residual)
    unheard = _unheard_tick(record)
    for index, tick in enumerate(record.ticks):
        newest = tick_at(record.ticks[0].deadline_ns, tick.decided_ns, record.info.schedule.control_hz)
        is_skipped = newest > index
        if is_skipped or tick.level == Level.SKIPPED:  # no command, no change of state
            yield from compare("Tick", index, is_skipped=(is_skipped, tick.level == Level.SKIPPED))
            yield from compare("Tick", index, action=(_NO_FLOATS, tick.action), sent=(False, index in actions))
            playing.commander.skip(1)
            continue
        while engaged and engaged[0] <= index:
            engaged.pop(0)
            playing.commander.engage()
        if tick.observation_tick in states:
            bits = {state.tobytes() for state in states[tick.observation_tick]}
            if tick.state.tobytes() not in bits:
                yield from compare("Tick", index, state=(states[tick.observation_tick][0], tick.state))
        usable = [c for c in covering(answers.admitted(tick.decided_ns), index) if c.age_ns <= playing.stale_limit_ns]
        yield from compare("Tick", index, **playing.step(tick, usable))
        if index not in actions:
            if index != unheard:
                yield from compare("Action", index, sent=(True, False))
        else:
            sent = actions[index]
            yield from compare(
                "Action",
                index,
                deadline_ns=(tick.deadline_ns, sent.deadline_ns),
                level=(tick.level, sent.level),
                values=(tick.action, sent.values),
            )


@dataclass(slots=True)
class _Playing:
    """Applies the rules tick by tick."""

    info: EpisodeInfo
    residual: ResidualHead | None
    commander: Commander = field(init=False)

    def __post_init__(self) -> None:
        self.commander = Commander(self.info)

    @property
    def stale_limit_ns(self) -> int:
        return self.info.schedule.stale_limit_ns

    def step(self, tick: Tick, usable: list[Chunk]) -> dict[str, tuple[Any, Any]]:
        """(expected, found) of every field of ``tick``; ``usable``: chunks with a row for it, oldest first."""
        newest, raw = None, _NO_FLOATS
        if usable:
            is_gripper_A = dimensions_of(self.info.robot).is_gripper_A
            joined, newest = seam_policy(self.info.schedule.seam, is_gripper_A)(usable, tick.tick), usable[-1]
            due = Due(row_A=joined, state=tick.state, row=tick.tick - newest.t_row0, age_ns=newest.age_ns)
            raw = corrected(self.residual, due, is_gripper_A)
        state, state_ticks = tick.state if len(tick.state) else None, tick.tick - tick.observation_tick
        sight = unfit(self.info.robot, tick.picture_age_ns, tick.picture_still_ns)
        decided = self.commander.step(raw, newest, state, tick.robot_state, state_ticks=state_ticks, sight=sight)
        chunk = decided.chunk
        age_ns = chunk.age_ns if chunk else 0
        return {
            "invocation": (chunk.invocation if chunk else None, tick.invocation),
            "t_row0": (chunk.t_row0 if chunk else 0, tick.t_row0),
            "row": (row_of(chunk, tick.tick) if chunk else 0, tick.row),
            "ref_query": (chunk.ref_query if chunk else None, tick.ref_query),
            "age_ns": (age_ns, tick.age_ns),
            "age_ms": (age_ns / NS_PER_MS, tick.age_ms),
            "raw_row": (raw, tick.raw_row),
            "limits_hit": (int(decided.hit), tick.limits_hit),
            "level": (decided.level, tick.level),
            "action": (decided.command, tick.action),
            "seam_jump": (decided.seam_jump, tick.seam_jump),
        }


def _unheard_tick(record: EpisodeRecord) -> int | None:
    """The last tick, if the robot had left: its Action may have been overtaken by its Tick as the log was closed."""
    has_left = record.result is not None and len(record.ticks) > record.result.num_ticks
    return len(record.ticks) - 1 if has_left and record.info.schedule.mode == Mode.REALTIME else None


def _logged_states(record: EpisodeRecord) -> dict[int, list[Floats]]:
    """Proprioception of the observations, by tick; a robot may send one twice."""
    states: dict[int, list[Floats]] = {}
    for observation in record.observations:
        states.setdefault(observation.tick, []).append(observation.proprio)
    return states
