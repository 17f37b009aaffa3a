"""What the schedule tells people: one event when something changes, not one a tick."""

from __future__ import annotations

from dataclasses import dataclass, field

from clock.limits import Hit, out_of_range
from clock.playback import Chunk
from clock.report import LEVEL_EVENT
from clock.sight import unfit_text
from protocol.messages import EpisodeInfo, Event, Level, Observation, RobotState, Severity

_SEVERITY = {Level.PLAY: Severity.INFO, Level.STALE: Severity.WARNING}


@dataclass(slots=True)
class Alarms:
    """Events of one episode. Each method returns what there is to tell at ``tick``."""

    info: EpisodeInfo
    _told: set[str] = field(default_factory=set)
    _robot_state: RobotState = RobotState.UNSPECIFIED
    _sight: Hit = Hit.NONE
    _is_blocked: bool = False

    def once(self, tick: int, severity: Severity, name: str, text: str) -> list[Event]:
        """An event that would repeat every tick: once per episode, later ones are counted in the ticks."""
        if name in self._told:
            return []
        self._told.add(name)
        return [Event(severity=severity, name=name, text=text, tick=tick)]

    def skipped(self, first_tick: int, end_tick: int) -> list[Event]:
        text = f"ticks {first_tick}..{end_tick - 1} passed unplayed: the clock service was not running"
        return [Event(severity=Severity.ERROR, name="ticks_skipped", text=text, tick=first_tick)]

    def pictures(self, tick: int, hit: Hit, age_ns: tuple[int, ...], still_ns: tuple[int, ...]) -> list[Event]:
        was, self._sight = self._sight, hit
        if hit and hit != was:
            text = f"{unfit_text(self.info.robot, hit, age_ns, still_ns)}. Held."
            return [Event(severity=Severity.ERROR, name="pictures_unfit", text=text, tick=tick)]
        if was and not hit:
            text = "the pictures are fresh again"
            return [Event(severity=Severity.INFO, name="pictures_fit", text=text, tick=tick)]
        return []

    def limits(self, tick: int, hit: Hit, chunk: Chunk | None, newest: Observation | None) -> list[Event]:
        events: list[Event] = []
        if Hit.NON_FINITE in hit and chunk is not None:
            text = f"chunk {chunk.invocation} has a NaN row: held"
            events += self.once(tick, Severity.ERROR, "non_finite_row", text)
        elif clipped := hit & ~(Hit.STATE | Hit.SIGHT):
            text = f"first row clipped to the robot's limits: {clipped.name}"
            events += self.once(tick, Severity.WARNING, "limit_hit", text)
        if Hit.STATE in hit and newest is not None:
            text = f"{out_of_range(newest.proprio, self.info.robot)} Held."
            events += self.once(tick, Severity.ERROR, "state_out_of_range", text)
        return events

    def blocked(self, tick: int, *, is_blocked: bool) -> list[Event]:
        was, self._is_blocked = self._is_blocked, is_blocked
        if was or not is_blocked:
            return []
        text = "the arm does not follow its commands: held. Is it blocked, or is max_lead too small?"
        return [Event(severity=Severity.ERROR, name="blocked", text=text, tick=tick)]

    def robot(self, tick: int, state: RobotState, said: str) -> list[Event]:
        was, self._robot_state = self._robot_state, state
        if state == was or (state.obeys and was.obeys):
            return []
        name, severity = ("robot_ok", Severity.INFO) if state.obeys else ("robot_stopped", Severity.ERROR)
        text = f"the robot says {state.name}" + (f": {said}" if said else "")
        return [Event(severity=severity, name=name, text=text, tick=tick)]

    def level(self, tick: int, before: Level, level: Level) -> list[Event]:
        schedule = self.info.schedule
        why = {
            Level.PLAY: "rows of a chunk with fresh cognition",
            Level.STALE: f"cognition older than {schedule.max_age_ns / 1e6:.0f} ms",
            Level.HOLD: "no usable row: the last commanded row is held",
            Level.DECELERATE: f"held for {schedule.hold_limit_ticks} ticks: towards the measured joints",
            Level.STOPPED: "stopped until somebody engages again",
        }[level]
        text = f"{before.name} -> {level.name}: {why}"
        return [Event(severity=_SEVERITY.get(level, Severity.ERROR), name=LEVEL_EVENT, text=text, tick=tick)]
