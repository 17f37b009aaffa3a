"""Stages of long work, run in slices of some minutes; a killed or ended slice is resumed.

A stage is a set of commands that run side by side, one a core, each of which resumes by itself; one that is alone has
all cores. One that has ended well is marked as done, and so is a stage without another. Stages are run in their order
until the slice is over: by its minutes, SIGTERM or Ctrl-C. What each has cost, and each of its commands, is added to
``hours.jsonl``, of which `account` makes a table.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from dual_system.analysis.markdown import markdown
from dual_system.training.ending import stop_requests

_ENDING_S = 120.0
"""What a command is given to save its state when a slice ends."""
_LOOK_S = 0.1
DONE, UNFINISHED, FAILED = 0, 3, 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """Commands, each a module and its arguments, that run side by side."""

    name: str
    commands: tuple[tuple[str, ...], ...]
    is_test: bool = False
    """Whether it plays test scenes, which no run of training may follow."""


def run_stages(stages: Iterable[Stage], folder: Path, minutes: float, before_test: Callable[[], None]) -> int:
    """Runs what is not done until a stage is unfinished or fails; ``before_test`` may refuse those that test."""
    folder.mkdir(parents=True, exist_ok=True)
    ends_s = time.monotonic() + 60 * minutes
    with stop_requests() as is_requested:
        for stage in stages:
            if _mark(stage, folder).exists():
                continue
            if stage.is_test:
                before_test()
            if code := _run(stage, folder, lambda: is_requested() or time.monotonic() >= ends_s):
                return code
    return DONE


def _mark(stage: Stage, folder: Path, number: int | None = None) -> Path:
    """The file that says that a stage is done, or the command of this number."""
    return folder / "done" / (stage.name.replace(" ", "_") + ("" if number is None else f".{number}"))


def _run(stage: Stage, folder: Path, is_over: Callable[[], bool]) -> int:
    """Runs a stage until it is done or the slice is over; adds its cost to the account."""
    if is_over():
        return UNFINISHED
    sys.stdout.write(f"--- {stage.name}\n")
    sys.stdout.flush()
    began_s = time.monotonic()
    _mark(stage, folder).parent.mkdir(exist_ok=True)
    left = [number for number in range(len(stage.commands)) if not _mark(stage, folder, number).exists()]
    threads = max(1, (os.cpu_count() or 1) // max(1, len(left)))
    processes: list[subprocess.Popen[bytes]] = []
    core_s: dict[int, float] = {}

    def ended(number: int) -> int:
        if is_over():
            return UNFINISHED
        command = [sys.executable, "-m", *stage.commands[number]]
        processes.append(process := subprocess.Popen(command, env=os.environ | {"OMP_NUM_THREADS": f"{threads}"}))
        code, core_s[number] = _ended(process, is_over)
        if not code:
            _mark(stage, folder, number).touch()
        return code

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            codes = list(pool.map(ended, left))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.kill()
    entry = {"stage": stage.name, "wall_s": time.monotonic() - began_s, "core_s": sum(core_s.values())}
    entry |= {"core_s_by_command": core_s}
    with (folder / "hours.jsonl").open("a") as file:
        file.write(json.dumps(entry) + "\n")
    if not any(codes):
        _mark(stage, folder).touch()
        return DONE
    if is_over():
        return UNFINISHED
    sys.stderr.write(f"{stage.name} ended with {codes}; what it printed says why\n")
    return FAILED


def _ended(process: subprocess.Popen[bytes], is_over: Callable[[], bool]) -> tuple[int, float]:
    """A command's exit code and processor time [s], its children's included.

    At the end of the slice it gets SIGTERM (nohup shields from Ctrl-C). What it has not saved is done again.
    """
    kill_s: float | None = None
    while True:
        pid, status, used = os.wait4(process.pid, os.WNOHANG)
        if pid:
            process.returncode = os.waitstatus_to_exitcode(status)
            return process.returncode, used.ru_utime + used.ru_stime
        if kill_s is None and is_over():
            process.terminate()
            kill_s = time.monotonic() + _ENDING_S
        elif kill_s is not None and time.monotonic() >= kill_s:
            process.kill()
        time.sleep(_LOOK_S)


def account(folder: Path) -> str:
    """What every stage has cost so far, as a table."""
    file = folder / "hours.jsonl"
    entries = [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []
    names = list(dict.fromkeys(entry["stage"] for entry in entries))
    rows = [_row(name, [entry for entry in entries if entry["stage"] == name]) for name in names]
    return markdown(["stage", "slices", "hours", "core-hours"], [*rows, _row("all", entries)]) + "\n"


def _row(name: str, entries: Sequence[dict[str, float]]) -> list[str]:
    wall_s, core_s = (sum(entry[key] for entry in entries) for key in ("wall_s", "core_s"))
    return [name, f"{len(entries)}", f"{wall_s / 3600:.2f}", f"{core_s / 3600:.2f}"]
