"""Mutated messages on every topic and call, in lockstep and in real time: who dies, what moves, what grows.

Three stages. *Members*, lockstep: before every message of a member goes a mutated copy under the member's own ids, as
if that process had a bug; nothing but the schedule's own checks stands between it and the state machines. *Strangers*,
lockstep and real time: mutated copies of everything that is heard, and calls, from a process that nobody named.
"""

from __future__ import annotations

import itertools
import json
import logging
import os
import shutil
import sys
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as Proto

from benchmarks.report import Report, Row, show
from benchmarks.rig import ROBOT, Rig
from clock.check import disagreements
from clock.check_gaps import before_gaps
from protocol import codec, topics
from protocol import messages as m
from protocol.bus import LocalBus
from protocol.command_line import On, parse
from protocol.drops import DropReason
from protocol.errors import CallFailed
from protocol.link import Link
from protocol.mcap_log import EpisodeRecord, read_log
from protocol.topics import CLOSE, CONTRACT, ENGAGE, JOURNAL, OPEN, STREAMS, TIME, Call, Priority

KEEP = Path("out/fuzz")
"""Folder for logs that are disputed."""
_ENUM, _MESSAGE, _STRING, _BYTES = 14, 11, 9, 12
_INTEGERS = (0, 1, -1, 255, 2**31 - 1, 2**32 - 1, 2**53, 2**53 + 1, 10**18, 2**63 - 1, -(2**63), 2**64 - 1)
_NUMBERS = (0.0, float("nan"), float("inf"), -1e30, 1e-45, 3.4e38)
_TEXTS = ("", "a/b*@", "x" * 129, "x" * 20_001, "\0", "../..")
_CALLS: dict[str, tuple[Call, ...]] = {
    "clock": (OPEN, CLOSE, topics.ACTIVE, JOURNAL, TIME, ENGAGE),
    "ponder": (OPEN, CLOSE, CONTRACT, TIME),
    "pounce": (OPEN, CLOSE, CONTRACT, TIME),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class FuzzOptions:
    """Sends mutated messages to the servers, the clock service and the robot's side while they play."""

    messages: int = 1_000_000
    """Mutated messages in all: a hundredth by members, whose episodes end early, and half of the rest in each mode."""
    seed: int = 0
    per_tick: int = 600
    """In lockstep: mutated messages between two ticks."""
    burst: int = 40
    """In real time: mutated messages at a time; between two bursts everybody gets a millisecond."""
    report: On = True
    """Do not write the report."""


class Mutator:
    """Damages protobuf messages: a field out of bounds, a list of another length, a flipped bit, a cut end, noise."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def __call__(self, proto: Proto, *, keeps_header: bool) -> bytes:
        """Returns damaged bytes of a copy of ``proto``."""
        copy = type(proto)()
        copy.CopyFrom(proto)
        kind = self._rng.integers(10)
        if kind < 7 or keeps_header:  # a header that is kept must still be readable
            for _ in range(self._rng.integers(1, 4)):
                self._change_field(copy, keeps_header)
            return copy.SerializeToString()
        payload = bytearray(copy.SerializeToString()) or bytearray(1)
        if kind == 7:
            payload[self._rng.integers(len(payload))] ^= 1 << self._rng.integers(8)
        elif kind == 8:
            payload = payload[: self._rng.integers(len(payload))]
        else:
            payload = bytearray(self._rng.bytes(self._rng.integers(0, 200)))
        return bytes(payload)

    def _pick(self, values: Any) -> Any:
        return values[self._rng.integers(len(values))]

    def _change_field(self, proto: Proto, keeps_header: bool) -> None:
        fields = [f for f in proto.DESCRIPTOR.fields if not (keeps_header and f.name == "header")]
        field = self._pick(fields)
        if field.type == _MESSAGE:
            is_map = field.message_type.GetOptions().map_entry
            inner = (
                getattr(proto, field.name) if not field.is_repeated else next(iter(getattr(proto, field.name)), None)
            )
            if self._rng.random() < 0.2:
                proto.ClearField(field.name)
            elif inner is not None and not is_map:
                self._change_field(inner, keeps_header=False)
            return
        try:
            if not field.is_repeated:
                setattr(proto, field.name, self._value(field))
                return
            values = getattr(proto, field.name)
            if values and self._rng.random() < 0.7:
                values[int(self._rng.integers(len(values)))] = self._value(field)
            else:
                del values[:]
                values.extend([self._value(field) for _ in range(self._pick((0, 1, 7, 9, 256, 300)))])
        except (ValueError, TypeError):  # protobuf refuses it already: too large for its type
            return

    def _value(self, field: Any) -> Any:
        if field.type == _STRING:
            return self._pick(_TEXTS)
        if field.type == _BYTES:
            return self._rng.bytes(int(self._pick((0, 1, 100, 100_000))))
        if field.type == _ENUM:
            return int(self._rng.integers(0, 8))
        if field.cpp_type in (field.CPPTYPE_FLOAT, field.CPPTYPE_DOUBLE):
            return self._pick(_NUMBERS) if self._rng.random() < 0.5 else float(self._rng.normal())
        if field.cpp_type == field.CPPTYPE_BOOL:
            return bool(self._rng.integers(2))
        return int(self._pick(_INTEGERS)) if self._rng.random() < 0.7 else int(self._rng.integers(0, 400))


_PROTO_OF = {topic.name: codec.proto_class(topic.cls) for topic in STREAMS}


class GarblingBus(LocalBus):
    """Sends a mutated copy, under the same ids, before every message of a member."""

    def __init__(self, mutate: Mutator, limit: int) -> None:
        super().__init__()
        self._mutate, self._limit = mutate, limit
        self.num_sent: Counter[str] = Counter()
        self.actions: list[m.Action] = []
        """The true ones."""

    def publish(self, key: str, payload: bytes, *, encoding: str, attachment: bytes, priority: Priority) -> None:
        name = key.split("/")[5] if "/ep/" in key else key.split("/")[3]
        if self.num_sent.total() < self._limit:
            try:
                damaged = self._mutate(_PROTO_OF[name].FromString(payload), keeps_header=True)
            except DecodeError:
                damaged = b"\xff"
            self.num_sent[name] += 1
            if name == "action":
                self.actions.append(codec.decode(m.Action, payload))
            super().publish(key, damaged, encoding=encoding, attachment=attachment, priority=priority)
        super().publish(key, payload, encoding=encoding, attachment=attachment, priority=priority)


@dataclass(slots=True)
class Outcome:
    """What a stage did to those who heard it."""

    sent: int
    episodes: int
    failures: int
    """Exceptions while a message was handled, and processes that died."""
    unsound: int
    """Commands outside of the joint limits or farther than a step from the one before."""
    disagree: int
    """Logs that ``pp-check`` disputes."""
    gaps: int
    """Logs that end for it before messages that never reached the recorder."""
    dropped: Counter[str]
    growth_mb: str
    robot: m.Robot | None = None


def members(options: FuzzOptions) -> Outcome:
    """Lockstep, one thread: messages of every member are damaged; whatever is played stays within the limits."""
    count = options.messages // 100
    bus = GarblingBus(Mutator(options.seed), count)
    accepts_any, Link.in_order = Link.in_order, lambda self, header, last_seq: True  # type: ignore[method-assign]
    try:
        with tempfile.TemporaryDirectory() as folder:
            outcome = _lockstep(bus, Path(folder), lambda: bus.num_sent.total() < count, lambda tick: None, 0.3, _read)
    finally:
        Link.in_order = accepts_any  # type: ignore[method-assign]
    outcome.sent = bus.num_sent.total()
    for _, played in itertools.groupby(bus.actions, key=lambda action: action.header.episode):
        outcome.unsound += _num_unsound(outcome.robot, list(played))  # type: ignore[arg-type]
    return outcome


def strangers(options: FuzzOptions) -> Outcome:
    """Lockstep, one thread: what everybody says is said again by a stranger, damaged; and calls."""
    count, bus, sent = _half(options), LocalBus(), Counter[str]()
    mutate = Mutator(options.seed + 1)
    ear = Link(bus, robot=ROBOT, proc="clock")
    streams = [(topic, ear.subscribe(topic, keep=64)) for topic in STREAMS]
    heard: dict[str, tuple[Any, Proto]] = {}

    def throw(tick: int) -> None:
        for topic, stream in streams:
            for sample in stream.subscription.drain():
                if ear.boot_id.to_bytes(8, "little") != sample.attachment[16:]:
                    heard[topic.name] = topic, _PROTO_OF[topic.name].FromString(sample.payload)
        for _ in range(max(1, options.per_tick // (2 * len(STREAMS)))):
            for topic, proto in heard.values():
                for _ in range(2):  # as many as every ring holds beside what is awaited
                    _say(bus, topic, mutate, proto, ear, sent)
            for proc, calls in _CALLS.items():
                _call(bus, proc, calls[sent.total() % len(calls)], mutate, ear, sent)
            bus.run_participants()

    with tempfile.TemporaryDirectory() as folder:
        outcome = _lockstep(bus, Path(folder), lambda: sent.total() < count, throw, 20, _judge)
    outcome.sent = sent.total()
    return outcome


def _say(bus: Any, topic: Any, mutate: Mutator, proto: Proto, ear: Link, sent: Counter[str]) -> None:
    copy = type(proto)()
    copy.CopyFrom(proto)
    header: Any = copy.header  # type: ignore[attr-defined]
    header.boot_id, sent[topic.name] = ear.boot_id, sent[topic.name] + 1
    key = topics.stream_key(topic, ROBOT, header.episode or "none", header.proc or "nobody")
    attachment = bytes(16) + ear.boot_id.to_bytes(8, "little")
    encoding = f"application/protobuf;{codec.type_name(topic.cls)}"
    payload = mutate(copy, keeps_header=bool(sent.total() % 2))
    bus.publish(key, payload, encoding=encoding, attachment=attachment, priority=topic.priority)


def _call(bus: LocalBus, proc: str, call: Call, mutate: Mutator, ear: Link, sent: Counter[str]) -> None:
    from protocol.bus import Request

    request = codec.proto_class(call.request)()
    payload = mutate(request, keeps_header=False)
    bus.serve(topics.call_key(call, ROBOT, proc)).put(Request(payload, lambda reply: None))
    sent[f"call {call.name}"] += 1


def _lockstep(
    bus: LocalBus,
    out: Path,
    goes_on: Callable[[], bool],
    on_tick: Callable[[int], None],
    patience_s: float,
    judge: Callable[[Path, Outcome], object],
) -> Outcome:
    """Plays episodes with all participants in this thread while ``goes_on()``."""
    import dual_system.tasks.headless  # noqa: F401, I001 - before anything that imports mujoco

    from clock.service import ClockService, ServiceConfig
    from ponder_server import in_process as ponder
    from pounce_server import in_process as pounce
    from sim_client.config import ScheduleOptions, ServersOptions, SimOptions
    from sim_client.suite import Suite

    links: list[Link] = []
    made = Link.__init__

    def keep(self: Link, *args: Any, **kwargs: Any) -> None:
        made(self, *args, **kwargs)
        links.append(self)

    Link.__init__ = keep  # type: ignore[method-assign]
    try:
        bus.add_participant(ponder.build(bus, ROBOT, None))
        bus.add_participant(pounce.build(bus, ROBOT, None))
        clock = ClockService(Link(bus, robot=ROBOT, proc="clock"), ServiceConfig(watches=False))
        bus.add_participant(clock.step)
        robot = Link(bus, robot=ROBOT, proc="sim")
    finally:
        Link.__init__ = made  # type: ignore[method-assign]
    plays = SimOptions(
        in_process=True, schedule=ScheduleOptions(max_steps=200), out=out, servers=ServersOptions(patience_s=patience_s)
    )
    outcome = Outcome(0, 0, 0, 0, 0, 0, Counter(), "")
    before_mb = _rss_mb("self")
    suite = Suite(plays, robot, clock, dead_server=lambda: "")
    while goes_on():
        (episode,) = suite.run(on_tick=lambda index, tick: on_tick(tick))["episodes"]
        outcome.episodes += 1
        judge(out / episode["mcap"], outcome)
        if outcome.episodes == 1:
            before_mb = _rss_mb("self")
    outcome.growth_mb = f"{_rss_mb('self') - before_mb:+.0f} of {before_mb:.0f}"
    for link in links:
        outcome.dropped.update(link.dropped)
    outcome.failures += outcome.dropped[DropReason.FAILED]
    return outcome


def _half(options: FuzzOptions) -> int:
    return (options.messages - options.messages // 100) // 2


def _read(path: Path, outcome: Outcome) -> EpisodeRecord:
    """A log that damaged accounts of members are in: it is whole, and would be disputed rightly."""
    record = read_log(path)
    outcome.robot = record.info.robot
    return record


def _judge(path: Path, outcome: Outcome) -> None:
    """Counts unsound commands, and whether the log follows from itself."""
    record, gap = before_gaps(_read(path, outcome))
    outcome.gaps += bool(gap)
    outcome.unsound += _num_unsound(record.info.robot, record.actions)
    if dispute := next(disagreements(record), None):
        outcome.disagree += 1
        KEEP.mkdir(parents=True, exist_ok=True)
        print(f"{dispute}; kept as {shutil.copy(path, KEEP / f'{uuid.uuid4().hex[:8]}.mcap')}", flush=True)


def _num_unsound(robot: m.Robot, actions: Sequence[m.Action]) -> int:
    """Number of commands of another size, out of the limits, or farther than a step from the one before."""
    num_unsound, last = 0, robot.initial_command
    largest = np.where(robot.max_step > 0, robot.max_step, np.inf) + 1e-4
    for action in actions:
        if action.values.shape != last.shape:
            num_unsound += 1
            continue
        step = np.abs(action.values - last)
        num_unsound += not bool(((robot.command_low <= action.values) & (action.values <= robot.command_high)).all())
        num_unsound += not bool((step <= largest).all())
        last = action.values
    return num_unsound


def realtime(options: FuzzOptions) -> Outcome:
    """Real processes over sockets: a stranger repeats what it hears, damaged, as fast as the machine allows."""
    count, mutate, sent = _half(options), Mutator(options.seed + 2), Counter[str]()
    outcome = Outcome(0, 0, 0, 0, 0, 0, Counter(), "")
    with tempfile.TemporaryDirectory() as name, Rig(Path(name)) as rig:
        folder, bus = Path(name), rig.bus
        ear = Link(bus, robot=ROBOT, proc="clock")
        streams = [(topic, ear.subscribe(topic, keep=8)) for topic in STREAMS]
        before: dict[str, float] = {}
        while sent.total() < count:
            out = folder / str(outcome.episodes)
            player = rig.play(["--max-steps", "300", "--seed", str(outcome.episodes), "--patience-s", "60"], out)
            heard: dict[str, tuple[Any, Proto]] = {}
            while player.poll() is None:
                for topic, stream in streams:
                    for sample in stream.subscription.drain()[-1:]:
                        if sample.attachment[16:] != ear.boot_id.to_bytes(8, "little"):
                            heard[topic.name] = topic, _PROTO_OF[topic.name].FromString(sample.payload)
                for number in range(options.burst if "tick" in heard and sent.total() < count else 0):
                    topic, proto = list(heard.values())[number % len(heard)]
                    _say(bus, topic, mutate, proto, ear, sent)
                if "tick" in heard and sent.total() % 400 < options.burst:
                    _ask(bus, mutate, sent)
                time.sleep(0.001)
            outcome.episodes += 1
            outcome.failures += _deaths(rig, out)
            for log in out.rglob("*.mcap"):
                _judge(log, outcome)
            if not before:
                before = _rss_of(rig)
        after = _rss_of(rig)
        outcome.growth_mb = ", ".join(
            f"{proc} {after[proc] - before[proc]:+.0f} of {before[proc]:.0f}" for proc in after
        )
        for proc in ("clock", "ponder", "pounce"):
            text = (folder / f"{proc}.log").read_text(errors="replace")
            outcome.failures += text.count("Traceback")
            outcome.dropped.update(reason for reason in DropReason if f"reason={reason}" in text)
    outcome.sent = sent.total()
    return outcome


def _ask(bus: Any, mutate: Mutator, sent: Counter[str]) -> None:
    """One damaged call to each server; whether an answer comes is not waited for long."""
    for proc, calls in _CALLS.items():
        call = calls[sent.total() % len(calls)]
        payload = mutate(codec.proto_class(call.request)(), keeps_header=False)
        try:
            bus.call(topics.call_key(call, ROBOT, proc), payload, timeout_ns=50_000_000)
        except CallFailed:
            continue
        finally:
            sent[f"call {call.name}"] += 1


def _deaths(rig: Rig, out: Path) -> int:
    """Daemons that left, and an episode that did not end as it should."""
    dead = [name for name, process in rig.daemons.processes.items() if process.poll() is not None]
    results = out / "results.json"
    episodes = json.loads(results.read_text())["episodes"] if results.exists() else []
    return len(dead) + (not episodes) + ((out / "sim.log").read_text(errors="replace").count("Traceback"))


def _rss_of(rig: Rig) -> dict[str, float]:
    return {name: _rss_mb(process.pid) for name, process in rig.daemons.processes.items()}


def _rss_mb(pid: int | str) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    return next(int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmRSS"))


def _row(stage: str, each: Outcome) -> Row:
    return {
        "stage": stage,
        "sent": each.sent,
        "episodes": each.episodes,
        "failures": each.failures,
        "unsound_commands": each.unsound,
        "logs_disputed": each.disagree,
        "logs_with_gaps": each.gaps,
        "growth_mb": each.growth_mb,
        "dropped": ", ".join(f"{reason} {count}" for reason, count in sorted(each.dropped.items())),
    }


def main(argv: list[str] | None = None) -> int:
    options = parse(FuzzOptions, argv, prog="python -m benchmarks.fuzz")
    logging.basicConfig(level=logging.CRITICAL)
    report = Report(
        name="fuzz",
        question="What do a million mutated messages do to the servers, the clock service and the robot's side?",
        config=options,
        warm_up="none; memory is compared with that after the first episode of a stage",
    )
    stages = (("members, lockstep", members), ("strangers, lockstep", strangers), ("strangers, real time", realtime))
    rows = []
    for name, stage in stages:
        rows.append(_row(name, stage(options)))
        print(rows[-1], flush=True)
    report.add_table("Mutated messages", rows)
    if options.report:
        report.write()
    show(report)
    return int(any(row["failures"] or row["unsound_commands"] or row["logs_disputed"] for row in rows))


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main())
