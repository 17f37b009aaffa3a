"""Hours of episodes with one set of servers and robots that come and go: does anything grow, and does every log agree?

python -m benchmarks.soak                                     # two hours of lockstep
python -m benchmarks.soak --mode realtime --minutes 30        # on a machine that does nothing else

Each log is checked like ``pp-check`` does when its episode is over, read for its latencies, and deleted.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.report import Report, Row, show, spread
from benchmarks.rig import Rig
from clock.check import disagreements
from protocol.command_line import On, command, parse
from protocol.errors import FileError
from protocol.mcap_log import EpisodeRecord, read_log
from sim_client.config import ModeName

_STOP_S = 60.0
_GROWN_UP_S = 60.0  # a robot's process imports, and makes its renderer


@dataclass(frozen=True, slots=True, kw_only=True)
class SoakOptions:
    """Plays episodes without end, and measures processes and logs."""

    mode: ModeName = "lockstep"
    minutes: float = 120.0
    warm_up_minutes: float = 2.0
    """Uncounted time at the start: caches fill."""
    every_s: float = 10.0
    """Time between two looks at the processes [s]."""
    max_steps: int = 400
    """Length of an episode [ticks]."""
    robot_minutes: float = 5.0
    """Life of a robot's process; then comes another one."""
    task: str = "PickHighlight"
    beside: str = "nothing"
    """What else ran on the machine; it is in the report."""
    report: On = True
    """Do not write the report."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """One process at one instant."""

    at_s: float
    rss_mb: float
    fds: int
    threads: int
    shm_mb: float
    """Shared memory that it maps."""


@dataclass(slots=True, kw_only=True)
class Soak:
    """What was seen so far."""

    looks: dict[str, list[Look]] = field(default_factory=dict)
    episodes: int = 0
    ticks: int = 0
    wrong: list[str] = field(default_factory=list)
    """Sentences about logs that disagree and processes that left."""
    latencies_ms: dict[str, list[list[float]]] = field(default_factory=dict)
    """By quantity: the values of each episode."""

    def take(self, log: Path) -> None:
        """Checks a finished log, and reads it."""
        self.episodes += 1
        try:
            record = read_log(log)
        except (OSError, FileError) as error:
            self.wrong.append(f"{log.name}: {error}")
            return
        found = next(disagreements(record), None)
        if found is not None or record.recovered:
            self.wrong.append(f"{log.name}: {found or record.why}")
        self.ticks += len(record.ticks)
        for name, values in _latencies_ms(record).items():
            self.latencies_ms.setdefault(name, []).append(values)


def _latencies_ms(record: EpisodeRecord) -> dict[str, list[float]]:
    commanded = [tick for tick in record.ticks if len(tick.action)]
    return {
        "tick decided after its deadline": [tick.late_ns / 1e6 for tick in commanded],
        "PONDER computes": [each.infer_ns / 1e6 for each in record.cognitions],
        "POUNCE computes": [each.infer_ns / 1e6 for each in record.chunks],
        "query to usable": [(s.arrived_ns - s.source_ns) / 1e6 for s in record.stamps if s.kind.name == "COGNITION"],
        "invocation to usable": [(s.arrived_ns - s.source_ns) / 1e6 for s in record.stamps if s.kind.name == "CHUNK"],
    }


def look(pid: int, at_s: float) -> Look:
    """Raises OSError if the process is gone."""
    process = Path(f"/proc/{pid}")
    status = dict(line.split(":", 1) for line in (process / "status").read_text().splitlines() if ":" in line)
    shared = [line.split() for line in (process / "maps").read_text().splitlines() if "/dev/shm/" in line]
    spans = [[int(end, 16) for end in words[0].split("-")] for words in shared]
    return Look(
        at_s=at_s,
        rss_mb=int(status["VmRSS"].split()[0]) / 1024,
        fds=len(os.listdir(process / "fd")),
        threads=int(status["Threads"]),
        shm_mb=sum(high - low for low, high in spans) / 2**20,
    )


def soak(options: SoakOptions) -> Soak:
    """Plays for the given time."""
    seen = Soak()
    with (
        tempfile.TemporaryDirectory() as name,
        Rig(Path(name), with_clock=options.mode == "realtime", allow_starved=options.mode == "realtime") as rig,
    ):
        out = Path(name) / "out"
        words = ["--episodes", "1000000", "--max-steps", str(options.max_steps), "--task", options.task]
        robots = (rig.play(words, out / str(number), mode=options.mode) for number in itertools.count())
        player = next(robots)
        start_s = born_s = time.monotonic()
        left: list[str] = []
        while (now_s := time.monotonic() - start_s) < 60 * options.minutes and not left:
            rig.listen(partial(_has_left, player), options.every_s)
            rig.heard.clear()
            if start_s + now_s - born_s > 60 * options.robot_minutes:
                _stop(player)
                player, born_s = next(robots), time.monotonic()
            for log in sorted(out.rglob("*.mcap")):
                seen.take(log)
                log.unlink()
            for proc, process in {**rig.daemons.processes, "sim": player}.items():
                if process.poll() is not None:
                    left.append(f"{proc} left with exit code {process.returncode}")
                elif proc != "sim" or time.monotonic() - born_s > _GROWN_UP_S:
                    seen.looks.setdefault(proc, []).append(look(process.pid, now_s))
        seen.wrong += left
        _stop(player)
    return seen


def _has_left(player: subprocess.Popen[bytes]) -> bool:
    return player.poll() is not None


def _stop(player: subprocess.Popen[bytes]) -> None:
    player.terminate()
    try:
        player.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        player.kill()
        player.wait()


def process_row(proc: str, looks: list[Look]) -> Row:
    """Start and end are means of a tenth of the looks each; the slope is that of the second half."""
    tenth = max(1, len(looks) // 10)
    row: Row = {"process": proc, "looks": len(looks)}
    for name in ("rss_mb", "fds", "threads", "shm_mb"):
        values = [float(getattr(each, name)) for each in looks]
        row[f"{name}_start"] = round(float(np.mean(values[:tenth])), 1)
        row[f"{name}_end"] = round(float(np.mean(values[-tenth:])), 1)
        row[f"{name}_max"] = round(max(values), 1)
    half = looks[len(looks) // 2 :]
    if len(half) > 2:
        slope = np.polyfit([each.at_s / 3600 for each in half], [each.rss_mb for each in half], 1)[0]
        row["rss_mb_per_h"] = round(float(slope), 2)
    return row


def latency_rows(name: str, episodes: list[list[float]]) -> list[Row]:
    """The first and the last tenth of the episodes, without the first one."""
    counted = episodes[1:]
    tenth = max(1, len(counted) // 10)
    parts = (("first tenth", counted[:tenth]), ("last tenth", counted[-tenth:]))
    return [{"what": name, "of": of, **spread([v for each in part for v in each], "ms")} for of, part in parts]


@command("soak")
def main(argv: list[str] | None = None) -> int:
    options = parse(SoakOptions, argv, prog="python -m benchmarks.soak")
    report = Report(
        name=f"soak_{options.mode}",
        question="Does anything grow, leak or slow down in hours of episodes, and does every log agree?",
        config=options,
        warm_up=f"{options.warm_up_minutes:g} minutes of the processes, one episode of the latencies",
    )
    seen = soak(options)
    counted = {
        proc: [each for each in looks if each.at_s >= 60 * options.warm_up_minutes]
        for proc, looks in seen.looks.items()
    }
    hours = max((looks[-1].at_s for looks in seen.looks.values()), default=0) / 3600
    report.add_table(
        "Played",
        [{"mode": options.mode, "hours": round(hours, 2), "episodes": seen.episodes, "ticks": seen.ticks,
          "simulated_hours": round(seen.ticks / 20 / 3600, 2), "wrong": len(seen.wrong)}],
    )  # fmt: skip
    report.add_table("Processes", [process_row(proc, looks) for proc, looks in counted.items() if looks])
    measured = {name: values for name, values in seen.latencies_ms.items() if len(values) > 2}
    report.add_table("Latencies", [row for name, values in measured.items() for row in latency_rows(name, values)])
    report.notes += [f"beside it on the machine: {options.beside}", *seen.wrong]
    if options.report:
        report.write()
    show(report)
    return int(bool(seen.wrong))


if __name__ == "__main__":
    sys.exit(main())
