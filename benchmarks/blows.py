"""The faults of ``benchmarks.faults``: drawn from a seed, struck, and lifted again."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.rig import Rig

Moment = Literal["opening", "playing", "closing"]
Place = Literal["unix", "tcp", "faketime"]
MOMENTS: tuple[Moment, ...] = ("opening", "playing", "closing")
SERVERS = ("ponder", "pounce", "clock")
_VICTIMS = (
    ("ponder",), ("pounce",), ("clock",), ("sim",), ("ponder", "pounce"), ("ponder", "clock"), ("pounce", "clock"),
    ("sim", "clock"), SERVERS,
)  # fmt: skip
_QUOTA_S, _PERIOD_S = 0.02, 0.1
_MEBIBYTE = 1 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault: what, to whom, when and for how long."""

    kind: str
    victims: tuple[str, ...]
    """The processes, or for the network the links; empty if it is the machine's."""
    moment: Moment
    at: float
    """Where in its moment, 0 to 1."""
    seconds: float
    amount: float
    """What else a kind needs, 0 to 1: how much is left, or how far a clock jumps."""

    @property
    def place(self) -> Place:
        """The rig that it needs."""
        return {"tcp_stalled": "tcp", "tcp_cut": "tcp", "wall_clock_jumped": "faketime"}.get(self.kind, "unix")  # type: ignore[return-value]

    @property
    def struck(self) -> frozenset[str]:
        """Processes that may die or fail of it. A machine's fault excuses nobody."""
        return frozenset(self.victims) if self.kind in _OF_PROCESSES else frozenset()

    @property
    def spoils_logs(self) -> bool:
        """Whether a log may end early, have gaps, or not be there."""
        return "sim" in self.struck or self.kind in ("disk_full", "folder_read_only", "tcp_stalled", "tcp_cut")


@dataclass(frozen=True, slots=True)
class Scene:
    """What can be struck."""

    rig: Rig
    player: subprocess.Popen[bytes]
    disk: Path
    """A file system of its own, with the episodes' logs."""
    time_file: Path
    """Offset of the faked wall clock."""

    def process(self, name: str) -> subprocess.Popen[bytes]:
        return self.player if name == "sim" else self.rig.daemons.processes[name]

    def signal(self, names: tuple[str, ...], number: int) -> None:
        for name in names:
            self.process(name).send_signal(number)  # does nothing if it is dead

    def kill(self, names: tuple[str, ...]) -> None:
        """Kills, and waits until they are gone: on a busy machine that takes its time."""
        self.signal(names, signal.SIGKILL)
        for name in names:
            self.process(name).wait(60)


def draw(seed: int, index: int) -> Fault:
    """The fault of trial ``index``; kinds come in turn, everything else is drawn."""
    rng = np.random.default_rng([seed, index])
    kind = tuple(KINDS)[index % len(KINDS)]
    victims: tuple[str, ...] = _VICTIMS[rng.integers(len(_VICTIMS))]
    if kind in ("fds_limited", "memory_limited"):
        victims = _VICTIMS[rng.integers(4)]
    elif kind in ("tcp_stalled", "tcp_cut"):
        victims = (("ponder",), ("pounce",), ("clock",), SERVERS)[rng.integers(4)]
    elif kind not in _OF_PROCESSES:
        victims = ()
    moments = MOMENTS[rng.choice(3, p=(0.25, 0.5, 0.25))]
    seconds = float(np.exp(rng.uniform(np.log(0.2), np.log(5))))
    return Fault(kind=kind, victims=victims, moment=moments, at=rng.random(), seconds=seconds, amount=rng.random())


@contextmanager
def _killed(fault: Fault, scene: Scene) -> Iterator[None]:
    scene.kill(fault.victims)
    yield


@contextmanager
def _frozen(fault: Fault, scene: Scene) -> Iterator[None]:
    scene.signal(fault.victims, signal.SIGSTOP)
    try:
        yield
    finally:
        scene.signal(fault.victims, signal.SIGCONT)


@contextmanager
def _frozen_then_killed(fault: Fault, scene: Scene) -> Iterator[None]:
    scene.signal(fault.victims, signal.SIGSTOP)
    try:
        yield
    finally:
        scene.kill(fault.victims)


@contextmanager
def _starved(fault: Fault, scene: Scene) -> Iterator[None]:
    """A fifth of a processor each, in slices of 100 ms, as a container's quota gives it out."""
    ends = threading.Event()

    def flicker() -> None:
        while not ends.is_set():
            scene.signal(fault.victims, signal.SIGSTOP)
            ends.wait(_PERIOD_S - _QUOTA_S)
            scene.signal(fault.victims, signal.SIGCONT)
            ends.wait(_QUOTA_S)

    thread = threading.Thread(target=flicker)
    thread.start()
    try:
        yield
    finally:
        ends.set()
        thread.join()


@contextmanager
def _limited(fault: Fault, scene: Scene, which: int, of: Callable[[int], int]) -> Iterator[None]:
    """Lowers a limit of each victim to what it uses, and little more."""
    before: dict[int, tuple[int, int]] = {}
    for name in fault.victims:
        process = scene.process(name)
        with contextlib.suppress(OSError):  # it is dead already
            before[process.pid] = resource.prlimit(process.pid, which)
            now = of(process.pid)
            resource.prlimit(process.pid, which, (now, before[process.pid][1]))
    try:
        yield
    finally:
        for pid, limits in before.items():
            with contextlib.suppress(OSError):
                resource.prlimit(pid, which, limits)


def _fds_limited(fault: Fault, scene: Scene) -> AbstractContextManager[None]:
    def of(pid: int) -> int:
        return max(int(name) for name in os.listdir(f"/proc/{pid}/fd")) + 1 + round(3 * fault.amount)

    return _limited(fault, scene, resource.RLIMIT_NOFILE, of)


def _memory_limited(fault: Fault, scene: Scene) -> AbstractContextManager[None]:
    def of(pid: int) -> int:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[0])
        return pages * resource.getpagesize() + round(8 * fault.amount * _MEBIBYTE)

    return _limited(fault, scene, resource.RLIMIT_AS, of)


@contextmanager
def _full(folder: Path, left: int) -> Iterator[None]:
    """Fills the file system of ``folder`` up to ``left`` bytes."""
    ballast = folder / "ballast"
    try:
        with ballast.open("wb") as file:
            free = os.statvfs(folder)
            os.posix_fallocate(file.fileno(), 0, max(1, free.f_bavail * free.f_frsize - left))
        yield
    finally:
        ballast.unlink()


def _disk_full(fault: Fault, scene: Scene) -> AbstractContextManager[None]:
    return _full(scene.disk, round(fault.amount**2 * _MEBIBYTE))


def _shm_full(fault: Fault, scene: Scene) -> AbstractContextManager[None]:
    return _full(Path("/dev/shm"), round(fault.amount**2 * _MEBIBYTE))


@contextmanager
def _read_only(fault: Fault, scene: Scene) -> Iterator[None]:
    """No file can be made, renamed or removed; open ones can be written, as after losing the right to the folder."""
    folders = [scene.disk, *(path for path in scene.disk.rglob("*") if path.is_dir())]
    subprocess.run(["chattr", "+i", *map(str, folders)], check=True)
    try:
        yield
    finally:
        subprocess.run(["chattr", "-i", *map(str, folders)], check=True)


@contextmanager
def _clock_jumped(fault: Fault, scene: Scene) -> Iterator[None]:
    """The wall clock alone, up to a day forwards or backwards, and back again."""
    far = 10 ** (5 * abs(2 * fault.amount - 1))
    scene.time_file.write_text(f"{far if fault.amount > 0.5 else -far:+.3f}s\n")
    try:
        yield
    finally:
        scene.time_file.write_text("+0\n")


@contextmanager
def _stalled(fault: Fault, scene: Scene) -> Iterator[None]:
    proxies = [scene.rig.proxies[name] for name in fault.victims]
    for proxy in proxies:
        proxy.cut() if fault.kind == "tcp_cut" else proxy.stall()
    try:
        yield
    finally:
        for proxy in proxies:
            proxy.flow()


KINDS: dict[str, Callable[[Fault, Scene], AbstractContextManager[None]]] = {
    "killed": _killed,
    "frozen": _frozen,
    "tcp_stalled": _stalled,
    "frozen_then_killed": _frozen_then_killed,
    "disk_full": _disk_full,
    "folder_read_only": _read_only,
    "shm_full": _shm_full,
    "fds_limited": _fds_limited,
    "memory_limited": _memory_limited,
    "cpu_starved": _starved,
    "wall_clock_jumped": _clock_jumped,
    "tcp_cut": _stalled,
}
_OF_PROCESSES = ("killed", "frozen", "frozen_then_killed", "fds_limited", "memory_limited", "cpu_starved")


def strike(fault: Fault, scene: Scene) -> None:
    """Strikes, waits, and lifts what can be lifted; who died of it stays dead."""
    with KINDS[fault.kind](fault, scene):
        time.sleep(fault.seconds)
