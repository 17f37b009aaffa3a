"""Fault injection: each daemon is killed (``kill -9``) or frozen (SIGSTOP) in mid-episode, several times.

Per trial: the time to detection, the ladder's levels meanwhile, the episode's end, and whether its log is complete and
passes pp-check. PONDER is restarted or continued, and the episode recovers. For comparison the same faults hit the
server of the real openpi-client.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.noop_policy import INSTRUCTION, NUM_PROPRIO
from benchmarks.report import Report, Row, show
from benchmarks.rig import Rig
from clock.check import disagreements
from protocol import messages as m
from protocol.command_line import parse
from protocol.errors import ProtocolError
from protocol.mcap_log import read_log
from sim_client.launch import free_ports

Blow = Literal["kill -9", "SIGSTOP"]
BLOWS: tuple[Blow, ...] = ("kill -9", "SIGSTOP")
_SIGNALS = {"kill -9": signal.SIGKILL, "SIGSTOP": signal.SIGSTOP}
_STRUCK_AT_TICK = 50
_PATIENCE_S = 60.0
_NOTICED_BY = {"ponder": "ponder_lost", "pounce": "pounce_lost", "clock": "clock_lost"}


@dataclass(frozen=True, slots=True, kw_only=True)
class DrillOptions:
    """Kills or freezes each daemon in mid-episode."""

    trials: int = 5
    max_steps: int = 360
    """Length of a surviving episode [ticks]; 18 s."""
    openpi_cap_s: float = 5.0
    """Limit of the wait for openpi's client to notice [s]."""
    task: str = "PickHighlight"


@dataclass(slots=True, kw_only=True)
class Trial:
    """One fault and its consequences; instants in seconds after the fault."""

    noticed_s: float | None = None
    back_s: float | None = None
    """Time from the restart (or SIGCONT) until the server is back in the episode, with its context rebuilt."""
    playing_s: float | None = None
    """Time from the restart to the next row played with fresh cognition."""
    ladder: list[tuple[str, float]] = field(default_factory=list)
    """Changes of the ladder's level, with their instants."""
    ended: str = ""
    is_whole: bool = False
    agrees: bool = False
    finding: str = ""


def drill(name: str, blow: Blow, options: DrillOptions) -> list[Trial]:
    """Runs all trials of one kind with one set of daemons; the victim is up again before the next trial."""
    with tempfile.TemporaryDirectory() as folder, Rig(Path(folder)) as rig:
        return [strike(rig, name, blow, seed, Path(folder) / str(seed), options) for seed in range(options.trials)]


def strike(rig: Rig, name: str, blow: Blow, seed: int, out: Path, options: DrillOptions) -> Trial:
    """Runs one episode with one fault."""
    trial = Trial()
    player = rig.play(["--task", options.task, "--seed", str(seed), "--max-steps", str(options.max_steps)], out)
    if not rig.listen(lambda: len(rig.ticks()) >= _STRUCK_AT_TICK, _PATIENCE_S):
        raise RuntimeError(f"{name} {blow}: the episode never ran")
    victim = rig.daemons.processes[name]
    struck_ns = time.monotonic_ns()
    victim.send_signal(_SIGNALS[blow])
    if rig.listen(lambda: rig.event(_NOTICED_BY[name]) is not None, _PATIENCE_S):
        trial.noticed_s = _seconds_since(struck_ns, rig, _NOTICED_BY[name])
    if name == "ponder":
        _bring_back(rig, blow, victim, trial)
    rig.listen(lambda: player.poll() is not None, _PATIENCE_S)
    trial.ladder = list(_changes(rig, struck_ns))
    if name != "ponder":
        _revive(rig, name, blow, victim)
    _judge(out, trial)
    return trial


def _revive(rig: Rig, name: str, blow: Blow, victim: subprocess.Popen[bytes]) -> None:
    if blow == "SIGSTOP":
        victim.send_signal(signal.SIGCONT)
    else:
        victim.wait()
        rig.restart(name)


def _bring_back(rig: Rig, blow: Blow, victim: subprocess.Popen[bytes], trial: Trial) -> None:
    """Restarts a killed PONDER immediately; continues a frozen one once its last cognition is stale."""
    if blow == "SIGSTOP":
        rig.listen(lambda: rig.ticks()[-1].level == m.Level.STALE, _PATIENCE_S)
    since_ns = time.monotonic_ns()
    _revive(rig, "ponder", blow, victim)
    if rig.listen(lambda: rig.event("ponder_back") is not None, _PATIENCE_S):
        trial.back_s = _seconds_since(since_ns, rig, "ponder_back")
    newest = max((tick.ref_query for tick in rig.ticks() if tick.ref_query is not None), default=-1)

    def plays_fresh() -> bool:
        tick = rig.ticks()[-1]
        return tick.level == m.Level.PLAY and tick.ref_query is not None and tick.ref_query > newest

    if rig.listen(plays_fresh, _PATIENCE_S):
        trial.playing_s = (time.monotonic_ns() - since_ns) / 1e9


def _seconds_since(since_ns: int, rig: Rig, event: str) -> float | None:
    heard = rig.event(event)
    return None if heard is None else (heard.at_ns - since_ns) / 1e9


def _changes(rig: Rig, struck_ns: int) -> Iterator[tuple[str, float]]:
    """The level at the fault, then every change of it."""
    level = None
    for heard in rig.heard:
        tick = heard.message
        if isinstance(tick, m.Tick) and heard.at_ns >= struck_ns and tick.level != level:
            level = tick.level
            yield level.name, (heard.at_ns - struck_ns) / 1e9


def _judge(folder: Path, trial: Trial) -> None:
    """Reads the episode's end from results.json, and checks its log."""
    results = folder / "results.json"
    if not results.exists():
        trial.ended = "no results.json"
        return
    (episode,) = json.loads(results.read_text())["episodes"]
    trial.ended = f"{episode['status']}: {episode['reason']}"
    try:
        record = read_log(folder / episode["mcap"])
    except (OSError, ProtocolError) as error:
        trial.finding = f"{type(error).__name__}: {error}"
        return
    trial.is_whole = not record.recovered and record.result is not None
    found = next(disagreements(record), None)
    trial.agrees, trial.finding = found is None, str(found or "")


def openpi_notices(blow: Blow, cap_s: float) -> float | None:
    """Seconds from a fault of the server until the real client raises; None if not within ``cap_s``."""
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    port = free_ports(1)[0]
    command = [sys.executable, "-m", "benchmarks.noop_policy", "openpi", "--port", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    noticed = threading.Event()
    calls = [0]
    picture = np.zeros((256, 256, 3), np.uint8)
    request = {
        "observation/image": picture,
        "observation/wrist_image": picture,
        "observation/state": np.zeros(NUM_PROPRIO, np.float32),
        "prompt": INSTRUCTION,
    }

    def call_at_20_hz(policy: WebsocketClientPolicy) -> None:
        try:
            while True:
                policy.infer(request)
                calls[0] += 1
                time.sleep(0.05)
        except Exception:
            noticed.set()

    try:
        assert server.stdout is not None
        server.stdout.readline()
        threading.Thread(target=call_at_20_hz, args=(WebsocketClientPolicy("127.0.0.1", port),), daemon=True).start()
        while calls[0] < 20:
            time.sleep(0.01)
        start_ns = time.monotonic_ns()
        os.kill(server.pid, _SIGNALS[blow])
        return (time.monotonic_ns() - start_ns) / 1e9 if noticed.wait(cap_s) else None
    finally:
        server.kill()
        server.wait()


def row_of(name: str, blow: Blow, trials: list[Trial]) -> Row:
    noticed = [t.noticed_s for t in trials if t.noticed_s is not None]
    back = [t.back_s for t in trials if t.back_s is not None]
    playing = [t.playing_s for t in trials if t.playing_s is not None]
    return {
        "struck": name,
        "by": blow,
        "n": len(trials),
        "noticed": f"{len(noticed)} of {len(trials)}",
        "noticed_ms_p50": _middle(noticed, 1e3),
        "noticed_ms_max": round(max(noticed) * 1e3, 1) if noticed else None,
        "back_s_p50": _middle(back),
        "playing_again_s_p50": _middle(playing),
        "logs_whole": f"{sum(t.is_whole for t in trials)} of {len(trials)}",
        "logs_agree": f"{sum(t.agrees for t in trials)} of {len(trials)}",
    }


def _middle(values: list[float], scale: float = 1.0) -> float | None:
    return round(float(np.percentile(values, 50, method="inverted_cdf")) * scale, 2) if values else None


def timeline_row(name: str, blow: Blow, trials: list[Trial]) -> Row:
    """The ladder of the first trial with its times, and the number of other trials with the same steps."""
    steps = [[level for level, _ in trial.ladder] for trial in trials]
    shown = " ".join(f"{level} {at_s:+.2f}" for level, at_s in trials[0].ladder)
    return {
        "struck": name,
        "by": blow,
        "ladder_s (first trial)": shown,
        "same steps": f"{steps.count(steps[0])} of {len(steps)}",
        "ended": "; ".join(sorted({trial.ended for trial in trials})),
    }


def main(argv: list[str] | None = None) -> int:
    options = parse(DrillOptions, argv, prog="fault-drill")
    report = Report(
        name="fault_drill",
        question="What happens when a daemon dies or freezes in mid-episode?",
        config=options,
        warm_up=f"the first {_STRUCK_AT_TICK} ticks of each episode; the blow comes then.",
    )
    trials: dict[tuple[str, Blow], list[Trial]] = {}
    for name in _NOTICED_BY:
        for blow in BLOWS:
            trials[name, blow] = drill(name, blow, options)
            print(row_of(name, blow, trials[name, blow]), flush=True)
    report.add_table("Ours", [row_of(name, blow, each) for (name, blow), each in trials.items()])
    report.add_table("The ladder", [timeline_row(name, blow, each) for (name, blow), each in trials.items()])
    peer: list[Row] = []
    for blow in BLOWS:
        noticed = [openpi_notices(blow, options.openpi_cap_s) for _ in range(options.trials)]
        found = [value for value in noticed if value is not None]
        peer.append(
            {
                "struck": "openpi's server",
                "by": blow,
                "n": len(noticed),
                "noticed": f"{len(found)} of {len(noticed)}",
                "noticed_ms_p50": _middle(found, 1e3) if found else f"not within {options.openpi_cap_s:.0f} s",
                "noticed_ms_max": round(max(found) * 1e3, 1) if found else f"not within {options.openpi_cap_s:.0f} s",
            }
        )
    report.add_table("Beside it: the real openpi-client 0.1.2, calling at 20 Hz", peer)
    report.notes += [
        f"n = {options.trials} per row: a trial takes up to 30 s, so these are drills, not distributions.",
        "noticed: from the signal to the event on the bus (ponder_lost and pounce_lost from the clock service, "
        "clock_lost from the robot's side). back: from restart or SIGCONT to ponder_back, start of Python and loading "
        "included. playing again: to the first row made with a new cognition.",
        "logs agree: pp-check derives every decision of the log again and finds no difference.",
    ]
    findings = sorted({t.finding for each in trials.values() for t in each if t.finding})
    report.notes += [f"pp-check found: {finding}" for finding in findings]
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
