"""A test rig for one experiment: daemons, a robot's process that plays episodes, and a listener on the bus.

The listener subscribes like the recorder, in the experiment's own process, so that an experiment also observes runs
without a log, and processes that die.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from benchmarks.proxy import Proxy
from protocol import messages as m
from protocol.link import Link
from protocol.topics import EVENT, TICK, alive_key
from protocol.zenoh_bus import Endpoints, ZenohBus
from sim_client.config import ModeName
from sim_client.launch import Daemons, free_ports, start_local

ROBOT = "r0"
_KEEP = 4096
_MODULES = {"ponder": "ponder_server", "pounce": "pounce_server", "clock": "clock"}


class Heard(NamedTuple):
    """A message and the instant at which the listener received it, on the host's monotonic clock."""

    message: m.Tick | m.Event
    at_ns: int


class Rig:
    """PONDER, POUNCE and, if it is not embedded in the robot's process, the clock service. A context manager.

    Args:
        folder: for what the daemons print.
        with_clock: whether the clock service is a daemon.
        proxied: whether the daemons listen on TCP and are reached through ``proxies``, by name.
        allow_starved: whether a busy machine may play a schedule that leaves ticks without a row.
    """

    def __init__(
        self, folder: Path, *, with_clock: bool = True, proxied: bool = False, allow_starved: bool = False
    ) -> None:
        self._of_clock = ["--allow-starved"] if allow_starved else []
        self.heard: list[Heard] = []
        self._episodes: set[str] = set()
        self._over: set[str] = set()
        self.daemons = Daemons(folder)
        self._players: list[subprocess.Popen[bytes]] = []
        self.proxies: dict[str, Proxy] = {}
        names = ("clock", "ponder", "pounce") if with_clock else ("ponder", "pounce")
        if proxied:
            ports = free_ports(len(names))
            self.proxies = {name: Proxy(port) for name, port in zip(names, ports, strict=True)}
            endpoints = tuple(f"tcp/127.0.0.1:{port}" for port in ports)
        else:
            endpoints = start_local(
                self.daemons, robot=ROBOT, with_clock=with_clock, allow_starved=allow_starved, ponder=[], pounce=[]
            )
        self._listens = dict(zip(names, endpoints, strict=True))
        self._reached = self._listens | {name: proxy.endpoint for name, proxy in self.proxies.items()}
        for name in self.proxies:
            self.restart(name)
        self._at_ear = f"tcp/127.0.0.1:{free_ports(1)[0]}"
        self.bus = ZenohBus(Endpoints(listen=(self._at_ear,), connect=endpoints))
        link = Link(self.bus, robot=ROBOT, proc="ear")
        self._robots = self.bus.watch_alive(alive_key(ROBOT, "sim"))
        self._streams = [link.subscribe(TICK, keep=_KEEP), link.subscribe(EVENT, keep=_KEEP)]

    def play(
        self, arguments: Sequence[str], out: Path, *, said: Path | None = None, mode: ModeName = "realtime"
    ) -> subprocess.Popen[bytes]:
        """Starts ``sim-client`` against these daemons; clears the messages heard so far.

        Args:
            out: folder for its results and logs.
            said: file for what it prints; ``sim.log`` in ``out`` if not given.
        """
        self._over |= self._episodes  # a continued clock service still sends messages of its old episode
        self.heard.clear()
        self._robots.drain()
        out.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "sim_client", "--mode", mode, "--out", str(out), "--no-progress"]
        command += ["--link.connect", *self._reached.values(), self._at_ear, *arguments]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
        with (said or out / "sim.log").open("ab") as log:
            player = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=log)
        self._players.append(player)
        return player

    def endpoint(self, name: str) -> str:
        """Where a daemon listens."""
        return self._reached[name]

    def restart(self, name: str) -> None:
        """Starts a daemon, for instance a killed one, at its endpoint."""
        arguments = ["--link.robot", ROBOT, "--link.listen", self._listens[name]]
        if name == "clock":
            arguments += ["--link.connect", self._reached["ponder"], self._reached["pounce"], *self._of_clock]
        self.daemons.start(name, _MODULES[name], arguments)

    def listen(self, is_enough: Callable[[], bool], patience_s: float) -> bool:
        """Listens until ``is_enough()``; returns False on timeout."""
        deadline_s = time.monotonic() + patience_s
        while not is_enough():
            if time.monotonic() > deadline_s:
                return False
            self.bus.wait(5_000_000)
            now_ns = time.monotonic_ns()
            for stream in self._streams:
                self.heard += [Heard(message, now_ns) for message in stream.drain() if self._is_new(message)]
        return True

    def _is_new(self, message: m.Tick | m.Event) -> bool:
        self._episodes.add(message.header.episode)
        return message.header.episode not in self._over

    def is_robot_there(self) -> bool:
        """Whether a robot's process came since the last call, or since ``play``."""
        return any(sample.payload for sample in self._robots.drain())

    def ticks(self) -> list[m.Tick]:
        return [h.message for h in self.heard if isinstance(h.message, m.Tick)]

    def event(self, name: str) -> Heard | None:
        """The first event of that name."""
        return next((h for h in self.heard if isinstance(h.message, m.Event) and h.message.name == name), None)

    def __enter__(self) -> Rig:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for player in self._players:
            player.kill()
            player.wait()
        self.bus.close()
        for proxy in self.proxies.values():
            proxy.close()
        self.daemons.__exit__(kind, error, trace)
