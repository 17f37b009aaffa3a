"""Shared fixtures: real processes on loopback, an ear on what they say, and a deadline on every wait."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from protocol import messages as m
from protocol.link import Link, Stream
from protocol.mcap_log import EpisodeRecord, read_log
from protocol.topics import EVENT, TICK
from protocol.zenoh_bus import Endpoints, ZenohBus
from sim_client import evaluate
from sim_client.condition import Job
from sim_client.launch import Daemons, free_ports, start_local

PATIENCE_S = 60.0  # for anything; a loaded machine takes 15 s to start PONDER
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1", "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
_MODULES = {"ponder": "ponder_server", "pounce": "pounce_server", "clock": "clock"}


class Finished(NamedTuple):
    """One episode, as its results.json and its log tell it."""

    result: dict[str, Any]
    record: EpisodeRecord
    results: dict[str, Any]


def finished(out: Path) -> Finished:
    """The only episode in ``out``."""
    results = json.loads((out / "results.json").read_text())
    (episode,) = results["episodes"]
    return Finished(episode, read_log(out / episode["mcap"]), results)


class Player:
    """A ``sim-client`` in real time, and what is heard while it plays."""

    def __init__(self, machine: Machine, out: Path, *arguments: str) -> None:
        self.out = out
        self.ticks: list[m.Tick] = []
        self.events: list[m.Event] = []
        self._machine = machine
        machine.forget_old_episodes()
        command = [sys.executable, "-m", "sim_client", "--mode", "realtime", "--no-progress", "--out", str(out)]
        command += ["--link.connect", *machine.endpoints.values(), machine.at_ear, *arguments]
        out.mkdir(parents=True, exist_ok=True)
        with (out / "sim.log").open("wb") as log:
            self.process = subprocess.Popen(command, env=ENVIRONMENT, stdout=log, stderr=log)

    def wait_for(self, what: str, is_so: Callable[[], bool], patience_s: float = PATIENCE_S) -> None:
        """Hears until it is so; fails if it never is."""
        deadline_s = time.monotonic() + patience_s
        while not is_so():
            if time.monotonic() > deadline_s:
                pytest.fail(f"{what}: not within {patience_s:.0f} s; heard {[e.name for e in self.events]}")
            self._machine.listen(self.ticks, self.events)

    def wait_for_tick(self, tick: int) -> None:
        self.wait_for(f"tick {tick}", lambda: bool(self.ticks) and self.ticks[-1].tick >= tick)

    def wait_for_event(self, name: str, count: int = 1) -> None:
        self.wait_for(name, lambda: sum(event.name == name for event in self.events) >= count)

    def wait_for_level(self, level: m.Level) -> None:
        self.wait_for(level.name, lambda: bool(self.ticks) and self.ticks[-1].level == level)

    def wait_for_end(self) -> Finished:
        self.wait_for("the end of sim-client", lambda: self.process.poll() is not None)
        return finished(self.out)


class Machine:
    """PONDER, POUNCE and the clock service as processes; any of them can be struck and comes back."""

    def __init__(self, folder: Path, ponder: Sequence[str] | None = (), pounce: Sequence[str] = ()) -> None:
        self._daemons = Daemons(folder)
        endpoints = start_local(self._daemons, robot="r0", with_clock=True, ponder=ponder, pounce=pounce)
        names = ("clock", "pounce") if ponder is None else ("clock", "ponder", "pounce")
        self.endpoints = dict(zip(names, endpoints, strict=True))
        self.at_ear = f"tcp/127.0.0.1:{free_ports(1)[0]}"
        self._bus = ZenohBus(Endpoints(listen=(self.at_ear,), connect=endpoints))
        link = Link(self._bus, robot="r0", proc="ear")
        self._ticks: Stream[m.Tick] = link.subscribe(TICK, keep=4096)
        self._events: Stream[m.Event] = link.subscribe(EVENT, keep=4096)
        self._players: list[subprocess.Popen[bytes]] = []
        self._heard: set[str] = set()
        self._over: set[str] = set()

    def play(self, out: Path, *arguments: str) -> Player:
        player = Player(self, out, *arguments)
        self._players.append(player.process)
        return player

    def kill(self, name: str) -> None:
        self._daemons.processes[name].kill()
        self._daemons.processes[name].wait()

    def freeze(self, name: str) -> None:
        self._daemons.processes[name].send_signal(signal.SIGSTOP)

    def thaw(self, name: str) -> None:
        self._daemons.processes[name].send_signal(signal.SIGCONT)

    def restart(self, name: str) -> None:
        arguments = ["--link.robot", "r0", "--link.listen", self.endpoints[name]]
        if name == "clock":
            arguments += ["--link.connect", self.endpoints["ponder"], self.endpoints["pounce"]]
        self._daemons.start(name, _MODULES[name], arguments)

    def listen(self, ticks: list[m.Tick], events: list[m.Event]) -> None:
        """Adds what is said in the newest episode."""
        self._bus.wait(10_000_000)
        ticks += [tick for tick in self._ticks.drain() if self._is_new(tick.header.episode)]
        events += [event for event in self._events.drain() if self._is_new(event.header.episode)]

    def forget_old_episodes(self) -> None:
        """A thawed clock service still has something to say about an episode that is over."""
        self._over |= self._heard

    def _is_new(self, episode: str) -> bool:
        self._heard.add(episode)
        return episode not in self._over

    def end(self) -> None:
        for player in self._players:
            player.kill()
            player.wait()
        self._bus.close()
        for name, process in self._daemons.processes.items():
            if process.poll() is None:
                self.thaw(name)
        self._daemons.__exit__(None, None, None)


@pytest.fixture(scope="session")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """One for all files: whatever a test strikes, it brings back."""
    machine = Machine(tmp_path_factory.mktemp("daemons"))
    yield machine
    machine.end()


@pytest.fixture(scope="session")
def machine_with() -> type[Machine]:
    """Another one: PONDER's options, None without one, and POUNCE's."""
    return Machine


@pytest.fixture(scope="session")
def run_module() -> Callable[..., subprocess.CompletedProcess[str]]:
    """``run_module("clock", "--help")`` runs ``python -m clock --help`` to its end."""

    def run(module: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", module, *arguments]
        return subprocess.run(
            command, env=ENVIRONMENT, capture_output=True, text=True, timeout=2 * PATIENCE_S, check=False
        )

    return run


class _Here:
    """Instead of workers."""

    def __init__(self, num_workers: int, play: Callable[[Job], evaluate.Line]) -> None:
        pass

    def run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, evaluate.Line]]:
        with contextlib.closing(evaluate.EvaluationHarness(jobs[0].options)) as harness:
            for job in jobs:
                yield job, harness.play(job)


@pytest.fixture
def evaluate_here(short_warm_up: None, monkeypatch: pytest.MonkeyPatch) -> Callable[[Sequence[str]], int]:
    """``pp-eval`` without a worker, which would import and warm up everything for itself."""

    def run(arguments: Sequence[str]) -> int:
        with monkeypatch.context() as patch:
            patch.setattr(evaluate, "LocalWorkers", _Here)
            return evaluate.main([*arguments])

    return run


@pytest.fixture(scope="session")
def episode_in() -> Callable[[Path], Finished]:
    """Reads the one episode that a ``sim-client`` left in its folder."""
    return finished
