"""Starts the servers that an episode needs on this machine, and takes them down again.

They are started by module name: this package imports no other server's code, so a robot's computer needs no torch.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import IO

from protocol.options import LinkOptions
from protocol.process import PARENT_VARIABLE
from protocol.sockets import endpoint
from sim_client.config import ModelsOptions

_GRACE_S = 5.0


def free_ports(count: int) -> list[int]:
    """Free loopback ports; if another process takes one meanwhile, the server reports it."""
    sockets = [socket.socket() for _ in range(count)]
    try:
        for s in sockets:
            s.bind(("127.0.0.1", 0))
        return [int(s.getsockname()[1]) for s in sockets]
    finally:
        for s in sockets:
            s.close()


class Daemons:
    """Server processes by name, each with its log file. A context manager: leaving it stops them all."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._files: list[IO[bytes]] = []
        self._sockets: Path | None = None
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, module: str, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
        """Starts ``python -m module arguments`` with its output in ``<name>.log``."""
        self._logs.mkdir(parents=True, exist_ok=True)
        file = (self._logs / f"{name}.log").open("ab")
        self._files.append(file)
        environment = os.environ | {
            "OMP_NUM_THREADS": "1",
            "PYTHONUNBUFFERED": "1",
            PARENT_VARIABLE: str(os.getpid()),  # if we are killed, they leave by themselves
        }
        command = [sys.executable, "-m", module, *arguments]
        self.processes[name] = subprocess.Popen(command, stdout=file, stderr=file, env=environment)
        return self.processes[name]

    def stop(self, name: str) -> None:
        """Ends one daemon, as leaving ends all of them."""
        process = self.processes.pop(name)
        process.terminate()
        try:
            process.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def await_line(self, names: Sequence[str], text: str, patience_s: float, count: int = 1) -> None:
        """Waits until each of these daemons has said ``text`` so often. Raises RuntimeError if one died or did not."""
        deadline_s = time.monotonic() + patience_s
        while any((self._logs / f"{name}.log").read_text(errors="replace").count(text) < count for name in names):
            if (why := self.dead()) or time.monotonic() > deadline_s:
                raise RuntimeError(why or f"{', '.join(names)} did not say {text!r} within {patience_s:.0f} s")
            time.sleep(0.1)

    def sockets(self) -> Path:
        """A folder for sockets that only this user may enter, and that goes with the daemons."""
        if self._sockets is None:
            self._sockets = Path(tempfile.mkdtemp(prefix="ponderpounce-", dir="/tmp"))
        return self._sockets

    def dead(self) -> str:
        """A sentence about the first daemon that left on its own; "" if all run."""
        for name, process in self.processes.items():
            code = process.poll()
            if code is not None:
                log = self._logs / f"{name}.log"
                lines = log.read_text(errors="replace").strip().splitlines()
                return f"{name} left with exit code {code}: {lines[-1] if lines else 'no output'} (see {log})"
        return ""

    def __enter__(self) -> Daemons:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            try:
                process.wait(_GRACE_S)
            except subprocess.TimeoutExpired:  # frozen, for instance by a fault drill
                process.kill()
                process.wait()
        for file in self._files:
            file.close()
        if self._sockets is not None:
            shutil.rmtree(self._sockets, ignore_errors=True)


def start_local(
    daemons: Daemons,
    *,
    robot: str,
    with_clock: bool,
    other_robots: Sequence[str] = (),
    allow_starved: bool = False,
    ponder: Sequence[str] | None,
    pounce: Sequence[str],
) -> tuple[str, ...]:
    """Starts the servers on sockets of their own, PONDER unless None; returns the endpoints to connect to.

    Every process listens on its own socket and connects to the servers it talks to, so that the death of one leaves
    the links among the others alone. The model servers are shared by all robots; each robot has a clock of its own.
    """
    models = {"pounce": pounce} if ponder is None else {"ponder": ponder, "pounce": pounce}
    at_models = [endpoint(proc, daemons.sockets()) for proc in models]
    robots = ["--link.robot", robot, *(["--other-robots", *other_robots] if other_robots else [])]
    for (proc, arguments), at_model in zip(models.items(), at_models, strict=True):
        daemons.start(proc, f"{proc}_server", [*robots, "--link.listen", at_model, *arguments])
    if not with_clock:
        return tuple(at_models)
    at_clocks = []
    options = [*(["--ponder", "none"] if ponder is None else []), *(["--allow-starved"] * allow_starved)]
    for index, each in enumerate((robot, *other_robots)):
        name = f"clock-{index}" if index else "clock"
        at_clocks.append(endpoint(name, daemons.sockets()))
        own = ["--link.robot", each, "--link.listen", at_clocks[-1], "--link.connect", *at_models]
        daemons.start(name, "clock", [*own, *options])
    return *at_clocks, *at_models


def local_link(
    daemons: Daemons,
    link: LinkOptions,
    *,
    with_clock: bool,
    allow_starved: bool,
    with_ponder: bool,
    other_robots: Sequence[str] = (),
    ponder_checkpoint: Path | None,
    pounce_checkpoint: Path | None,
    models: ModelsOptions | None = None,
) -> LinkOptions:
    """Starts the servers of ``--local`` for the robot of ``link``; returns how to reach them."""
    models = models or ModelsOptions()
    endpoints = start_local(
        daemons,
        robot=link.robot,
        other_robots=other_robots,
        with_clock=with_clock,
        allow_starved=allow_starved,
        ponder=_arguments(ponder_checkpoint, models.of_ponder()) if with_ponder else None,
        pounce=_arguments(pounce_checkpoint, models.of_pounce()),
    )
    return replace(link, connect=endpoints)


def _arguments(checkpoint: Path | None, options: Mapping[str, str]) -> list[str]:
    named = {} if checkpoint is None else {"checkpoint": str(checkpoint)}
    return [part for name, value in (named | {**options}).items() for part in (f"--{name}", value)]
