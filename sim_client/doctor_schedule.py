"""``pp-doctor --schedule``: whether running models are fast enough for their schedule, d <= s <= H - d."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from clock import schedules
from clock.feasibility import check_feasible
from protocol.errors import CallFailed, ProtocolError, TransportError
from protocol.link import Link
from protocol.messages import Contract, ContractRequest
from protocol.options import LinkOptions
from protocol.probe import trouble
from protocol.topics import CONTRACT
from protocol.zenoh_bus import open_bus
from sim_client.doctor_probes import Finding, Level, Ran, run
from sim_client.openpi_probe import RobotName

_PATIENCE_NS = 2_000_000_000
_OPENPI_LIMIT_S = 300.0  # a policy that compiles answers late at first
_NUM_CALLS = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduleProbeOptions:
    """Which models are asked, and for which schedule."""

    invoke_every_ticks: int | None = None
    """With --schedule: ticks between invocations. None: half the horizon, as in real time."""
    control_hz: int = schedules.CONTROL_HZ
    """With --schedule: ticks per second."""
    query_period_ms: int = 1000
    """With --schedule: period of PONDER's queries in ms. 0: one query an episode."""
    openpi: str | None = None
    """With --schedule: HOST:PORT of an openpi policy server, which is timed in place of our servers."""
    openpi_robot: RobotName = "droid"
    """Robot whose observation the openpi server is sent."""
    openpi_observation: Path | None = None
    """File of another observation: an .npz with the server's keys, texts as strings."""
    openpi_answers: int = 50
    """Number of answers that are timed, at least 2."""


def probes(options: ScheduleProbeOptions, link: LinkOptions) -> dict[str, Callable[[], Finding]]:
    """The checks, by name: PONDER's and POUNCE's, or the openpi server's."""
    if options.openpi is not None:
        return {"openpi": partial(openpi, options)}
    return {
        "ponder": partial(ponder, options, partial(measured, link, "ponder")),
        "pounce": partial(pounce, options, partial(measured, link, "pounce")),
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """A running model server: its contract, and the p99 of a call and its reply, in ns."""

    contract: Contract
    call_p99_ns: int

    @property
    def p99_ns(self) -> int:
        return self.contract.infer_p99_ns + self.call_p99_ns

    @property
    def text(self) -> str:
        """The measurements as a sentence."""
        contract = self.contract
        model = f"{contract.model_hash}{' (untrained)' if contract.is_fake else ''}"
        return (
            f"{model}: p99 {contract.infer_p99_ns / 1e6:.1f} ms at its warm-up and {self.call_p99_ns / 1e6:.1f} ms for "
            f"{_NUM_CALLS} calls."
        )


def pounce(options: ScheduleProbeOptions, measure: Callable[[], Measured]) -> Finding:
    """POUNCE's p99 against the invocations."""
    try:
        found = measure()
    except (TransportError, ProtocolError) as error:
        return _absent("pounce", error)
    return _verdict("pounce", found.text, found.p99_ns, found.contract.horizon, options)


def ponder(options: ScheduleProbeOptions, measure: Callable[[], Measured]) -> Finding:
    """PONDER's p99 against the period of its queries: beyond it, queries are late and cognition ages."""
    try:
        found = measure()
    except (TransportError, ProtocolError) as error:
        return _absent("ponder", error)
    p99_ms, period_ms = found.p99_ns / 1e6, options.query_period_ms
    if not period_ms:
        text = f"{found.text} It is asked once an episode: holds."
        return Finding("ponder", Level.OK, f"{text} Its cognition comes {p99_ms:.0f} ms after the start and is kept.")
    text = f"{found.text} It is asked every {period_ms} ms"
    if p99_ms <= period_ms:
        oldest_ms = period_ms + p99_ms
        return Finding("ponder", Level.OK, f"{text}: holds. A cognition in use is at most {oldest_ms:.0f} ms old.")
    way_out = f"Ask less often (--query-period-ms {-(-p99_ms // 100) * 100:.0f}), or use a faster model."
    return Finding("ponder", Level.WARNING, f"{text}: each query waits for the last one", way_out)


def openpi(options: ScheduleProbeOptions, run: Callable[..., Ran] = run) -> Finding:
    """A foreign server's p99, as its own client measures it, against the invocations that its horizon allows."""
    file = [] if options.openpi_observation is None else [str(options.openpi_observation)]
    command = [sys.executable, "-m", "sim_client.openpi_probe", str(options.openpi), options.openpi_robot]
    ran = run([*command, str(max(2, options.openpi_answers)), *file], {}, limit_s=_OPENPI_LIMIT_S)
    try:
        found = json.loads(ran.last_line)
    except ValueError:
        found = {"error": ran.last_line}
    if "error" in found:
        way_out = (
            f"Is an openpi server at --openpi {options.openpi}, and does it read what a {options.openpi_robot} sends? "
            "--openpi-robot and --openpi-observation change that."
        )
        return Finding("openpi", Level.FAILED, str(found["error"]), way_out)
    return _openpi_verdict(found, options)


def _openpi_verdict(found: dict[str, Any], options: ScheduleProbeOptions) -> Finding:
    durations_ns = sorted(found["durations_ns"])
    p50_ns, p99_ns = (durations_ns[-(-len(durations_ns) * q // 100) - 1] for q in (50, 99))
    text = (
        f"{options.openpi} answers with ({found['horizon']}, {found['action_dim']}): p50 {p50_ns / 1e6:.1f} ms, p99 "
        f"{p99_ns / 1e6:.1f} ms of {len(durations_ns)} answers."
    )
    return _verdict("openpi", text, p99_ns, found["horizon"], options)


def _verdict(name: str, text: str, p99_ns: int, horizon: int, options: ScheduleProbeOptions) -> Finding:
    schedule = schedules.realtime(options.control_hz, horizon)
    if options.invoke_every_ticks:
        schedule = replace(schedule, invoke_period_ticks=options.invoke_every_ticks)
    found = check_feasible(schedule, p99_ns)
    rule = replace(found, ways_out=()).sentence()
    return Finding(name, Level.OK if found.is_feasible else Level.FAILED, f"{text} {rule}", " ".join(found.ways_out))


def _absent(proc: str, error: Exception) -> Finding:
    way_out = f"Start {proc}-serve, or say where it listens: --link.connect"
    return Finding(proc, Level.FAILED, str(error), way_out)


def measured(link_options: LinkOptions, proc: str) -> Measured:
    """Asks a running server. Raises TransportError if it is not there or not ready."""
    bus = open_bus(link_options)
    try:
        link = Link(bus, robot=link_options.robot, proc="doctor")
        if why_not := trouble(link, proc, within_ns=_PATIENCE_NS):
            raise TransportError(why_not)
        durations_ns = []
        for _ in range(_NUM_CALLS):
            start_ns = time.monotonic_ns()
            reply = link.call(CONTRACT, proc, ContractRequest(), timeout_ns=_PATIENCE_NS)
            durations_ns.append(time.monotonic_ns() - start_ns)
        if reply.contract is None:
            raise CallFailed(proc, _PATIENCE_NS / 1e6, reply.error)
        return Measured(contract=reply.contract, call_p99_ns=max(durations_ns))
    finally:
        bus.close()
