"""What the page shows of one robot: the newest of every message, in plain values. Pure: messages and instants in.

It hears what anybody hears, and cannot tell a member of the episode from a stranger as the members can.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from clock.timebase import NS_PER_MS, NS_PER_S
from protocol import messages as m

NUM_TICKS = 600
"""Ticks of the strip (half a minute at 20 Hz)."""
_NUM_TEXTS = 12
_MAX_TEXT = 300


@dataclass(slots=True)
class _Camera:
    image: m.Image
    seq: int
    came_ns: int


@dataclass(slots=True)
class View:
    """Call ``on_*`` with messages and the instant at which they came, and ``status`` for the page."""

    robot: str
    cameras: dict[str, _Camera] = field(default_factory=dict)
    _info: m.EpisodeInfo | None = None
    _episode: str = ""
    _phases: dict[str, str] = field(default_factory=dict)
    _tokens: set[str] = field(default_factory=set)
    _healths: dict[str, tuple[m.Health, int]] = field(default_factory=dict)
    _ticks: deque[m.Tick] = field(default_factory=lambda: deque(maxlen=NUM_TICKS))
    _tick_ns: int = 0
    _seen: m.Observation | None = None
    _gate: tuple[int, float | None] | None = None  # query and score of PONDER's newest answer
    _subgoals: deque[m.Subgoal] = field(default_factory=lambda: deque(maxlen=_NUM_TEXTS))
    _events: deque[m.Event] = field(default_factory=lambda: deque(maxlen=_NUM_TEXTS))

    def on_token(self, proc: str, is_there: bool) -> None:
        (self._tokens.add if is_there else self._tokens.discard)(proc)

    def on_message(self, message: Any, now_ns: int) -> None:
        """Takes any message of the bus that is on the page."""
        match message:
            case m.Health():
                self._healths[message.header.proc] = (message, now_ns)
            case m.Phase():
                self._phases[message.header.proc] = message.state
            case m.EpisodeInfo():
                self._enter(message.header.episode)
                self._info = message
            case m.Tick():
                self._enter(message.header.episode)
                self._ticks.append(message)
                self._tick_ns = now_ns
            case m.Observation():
                self._enter(message.header.episode)
                self._seen = message
                for image in message.images:
                    last = self.cameras.get(image.camera)
                    self.cameras[image.camera] = _Camera(image, last.seq + 1 if last else 0, now_ns)
            case m.Cognition() if message.header.episode == self._episode:
                self._gate = message.query, message.gate_score
            case m.Subgoal():
                self._subgoals.appendleft(message)
            case m.Event():
                self._events.appendleft(message)

    def _enter(self, episode: str) -> None:
        if episode != self._episode:
            self._episode, self._info, self._seen, self._gate = episode, None, None, None
            self._ticks.clear()
            self._subgoals.clear()
            self.cameras.clear()

    def status(self, now_ns: int) -> dict[str, Any]:
        """The page's values; times in ms."""
        return {
            "robot": self.robot,
            "episode": self._named(),
            "now": self._now(now_ns),
            "ladder": [int(tick.level) for tick in self._ticks],
            "late_ms": [round(tick.late_ns / NS_PER_MS, 3) for tick in self._ticks],
            "cameras": [
                {"name": name, "seq": each.seq, "age_ms": _ms(now_ns - each.came_ns),
                 "px": f"{each.image.width} x {each.image.height}"}
                for name, each in sorted(self.cameras.items())
            ],
            "subgoals": [
                {"tick": each.tick, "kind": each.kind.name.lower(), "text": each.text[:_MAX_TEXT]}
                for each in self._subgoals
            ],
            "events": [
                {"tick": each.tick, "severity": each.severity.name.lower(), "name": each.name[:80],
                 "text": each.text[:_MAX_TEXT]}
                for each in self._events
            ],
            "processes": [self._process(proc, now_ns) for proc in sorted({*self._tokens, *self._healths})],
        }  # fmt: skip

    def _named(self) -> dict[str, Any]:
        info = self._info
        if info is None:
            return {"name": self._episode, "is_known": False}
        return {
            "name": self._episode,
            "is_known": True,
            "task": info.task,
            "instruction": info.instruction[:_MAX_TEXT],
            "suite": info.suite,
            "policy": info.policy,
            "robot": info.robot.name,
            "is_simulated": info.robot.is_simulated,
            "mode": info.schedule.mode.name.lower(),
            "control_hz": info.schedule.control_hz,
        }

    def _now(self, now_ns: int) -> dict[str, Any] | None:
        """The newest tick; None before the first one."""
        if not self._ticks:
            return None
        tick = self._ticks[-1]
        late = np.array([each.late_ns for each in self._ticks if each.level != m.Level.SKIPPED] or [0])
        said = self._seen.robot_text[:_MAX_TEXT] if self._seen is not None else ""
        return {
            "tick": tick.tick,
            "silent_ms": _ms(now_ns - self._tick_ns),
            "level": tick.level.name,
            "robot_state": tick.robot_state.name.lower(),
            "robot_text": said,
            "late_ms": round(tick.late_ns / NS_PER_MS, 3),
            "late_p50_ms": round(float(np.percentile(late, 50)) / NS_PER_MS, 3),
            "late_p99_ms": round(float(np.percentile(late, 99)) / NS_PER_MS, 3),
            "age_ms": round(tick.age_ns / NS_PER_MS),
            "query": tick.ref_query,
            "gate": self._gate and {"query": self._gate[0], "score": self._gate[1]},
            "invocation": tick.invocation,
            "row": tick.row,
            "limits_hit": tick.limits_hit,
            "action": [round(float(value), 4) for value in tick.action],
            "state": [round(float(value), 4) for value in tick.state],
        }

    def _process(self, proc: str, now_ns: int) -> dict[str, Any]:
        health, came_ns = self._healths.get(proc, (None, 0))
        told: dict[str, Any] = {"name": proc, "is_there": proc in self._tokens, "phase": self._phases.get(proc, "")}
        if health is not None:
            told |= {
                "state": health.state.name.lower(),
                "detail": health.detail[:_MAX_TEXT],
                "silent_ms": _ms(now_ns - came_ns),
                "model": health.model_hash,
                "is_fake": health.is_fake,
                "infer_p99_ms": round(health.infer_p99_ns / NS_PER_MS, 1),
                "answered": health.num_answered,
            }
        return told


def _ms(duration_ns: int) -> int:
    return min(duration_ns // NS_PER_MS, 1000 * NS_PER_S)
