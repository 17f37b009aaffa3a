"""Faults at random: processes killed and frozen, limits, full and read-only disks, links that stall, clocks that jump.

Each trial plays two short episodes in real time, and something is struck while the first one opens, plays or closes.
Then: is every log whole or cut for a reason that is named, does ``pp-check`` agree, did anything move unbidden, does
whoever was not struck live on without a traceback, and does the next episode play? Needs root on Linux, for file
systems of its own.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.blows import KINDS, MOMENTS, SERVERS, Fault, Place, Scene, draw, strike
from benchmarks.fault_judge import tracebacks, unbidden_in, verdict
from benchmarks.report import Report, Row, show
from benchmarks.rig import Rig
from protocol.command_line import On, command, parse

_OWN_NAMESPACE = "PONDERPOUNCE_FAULTS_HAS_ITS_OWN_MOUNTS"
_FAKETIME = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketimeMT.so.1")
_PATIENCE_S = 240.0
_OPENING_S, _CLOSING_S = 1.5, 0.4
_TRIALS_OF_A_RIG = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultsOptions:
    """Strikes the servers, the robot's side and their machine at random, and judges what is left."""

    trials: int = 200
    """Number of faults."""
    first: int = 0
    """Number of the first one: --first 37 --trials 1 repeats one."""
    seed: int = 0
    max_steps: int = 80
    """Length of an episode [ticks]; 4 s."""
    minutes: float = 1e9
    """No new trial is started after this time."""
    keep: Path = Path("out/faults")
    """Folder for what belongs to a wrong outcome."""
    report: On = True
    """Do not write the report."""


@dataclass(slots=True, kw_only=True)
class Trial:
    """A fault and what came of it."""

    index: int
    fault: Fault
    logs: list[str] = field(default_factory=list)
    """What each log is: whole, cut, or not recorded."""
    ends: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    """Sentences about what must not be."""


def run(trial: Trial, rig: Rig, folder: Path, options: FaultsOptions) -> None:
    """Plays both episodes, strikes, brings back who died, and judges."""
    fault, disk = trial.fault, folder / "disk"
    out = disk / str(trial.index)
    marks = {name: len(_text(folder / f"{name}.log")) for name in SERVERS}
    lengths = ["--max-steps", str(options.max_steps), "--difficulty", "easy", "--patience-s", "90"]
    player = rig.play([*lengths, "--episodes", "2", "--seed", str(trial.index)], out, said=folder / "sim.log")
    if not _await_moment(rig, player, trial.fault, options):
        trial.wrong.append("the moment to strike never came")
    strike(fault, Scene(rig, player, disk, folder / "time"))
    _bring_back(rig, trial)
    if not rig.listen(lambda: player.poll() is not None, _PATIENCE_S):
        trial.wrong.append("sim-client does not end")
        player.kill()
        player.wait()
    episodes = _episodes(out)
    if len(episodes) < 2 or not _has_played(episodes[-1]):  # struck itself, or the fault lasted into the second one
        _bring_back(rig, trial)
        again = disk / f"{trial.index}-again"
        second = rig.play([*lengths, "--seed", "1"], again, said=folder / "again.log")
        rig.listen(lambda: second.poll() is not None, _PATIENCE_S)
        if not any(map(_has_played, _episodes(again))):
            trial.wrong.append(f"the next episode does not play: {[each['reason'] for each in _episodes(again)]}")
    trial.ends = [f"{each['status']}: {each['reason']}" for each in episodes]
    said = {name: _text(folder / f"{name}.log")[mark:] for name, mark in marks.items()}
    said |= {"sim": _text(folder / "sim.log"), "sim again": _text(folder / "again.log")}
    _judge_logs(trial, disk, said["sim"], episodes)
    trial.wrong += [
        f"{name}: a traceback" for name, text in said.items() if name not in fault.struck and tracebacks(text)
    ]
    if trial.wrong:
        kept = options.keep / str(trial.index)
        shutil.rmtree(kept, ignore_errors=True)
        shutil.copytree(disk, kept)
        for name, text in said.items():
            (kept / f"{name}.txt").write_text(text)
    for left in (*disk.iterdir(), folder / "sim.log", folder / "again.log"):
        shutil.rmtree(left) if left.is_dir() else left.unlink(missing_ok=True)


def _await_moment(rig: Rig, player: subprocess.Popen[bytes], fault: Fault, options: FaultsOptions) -> bool:
    """Waits for the instant of a fault."""

    def reached(tick: int) -> bool:
        return player.poll() is not None or any(each.tick >= tick for each in rig.ticks())

    if fault.moment == "opening":
        came = rig.listen(lambda: player.poll() is not None or rig.is_robot_there(), _PATIENCE_S)
        time.sleep(_OPENING_S * fault.at)
        return came
    last = options.max_steps - 1
    came = rig.listen(lambda: reached(last if fault.moment == "closing" else round(fault.at * (last - 5))), _PATIENCE_S)
    time.sleep(_CLOSING_S * fault.at if fault.moment == "closing" else 0)
    return came


def _bring_back(rig: Rig, trial: Trial) -> None:
    """Starts the daemons that died; one that was not struck must not have."""
    for name, process in list(rig.daemons.processes.items()):
        if process.poll() is not None:
            if name not in trial.fault.struck:
                trial.wrong.append(f"{name} died with exit code {process.returncode}, and was not struck")
            rig.restart(name)


def _judge_logs(trial: Trial, disk: Path, said: str, episodes: list[dict[str, Any]]) -> None:
    logs = sorted([*disk.rglob("*.mcap"), *disk.rglob("*.mcap.partial")])
    for log in logs:
        state, why = verdict(log)
        if state == "wrong" or (state == "cut" and not trial.fault.spoils_logs):
            trial.wrong.append(f"{log.name}: {state}: {why}")
        trial.logs.append(state)
        trial.wrong += [f"{log.name}: {sentence}" for sentence in unbidden_in(log)[:3]]
    names = {log.name.removesuffix(".partial") for log in logs}
    for episode in episodes:
        if Path(episode["mcap"]).name not in names:
            is_said = any("log " in warning for warning in episode["warnings"]) or "No space left" in said
            trial.logs.append("not recorded")
            if not (trial.fault.spoils_logs and is_said):
                trial.wrong.append(f"{episode['mcap']}: no log, and nobody says why")


def _text(path: Path) -> str:
    return path.read_text(errors="replace") if path.exists() else ""


def _episodes(out: Path) -> list[dict[str, Any]]:
    results = out / "results.json"
    return json.loads(results.read_text())["episodes"] if results.exists() else []


def _has_played(episode: dict[str, Any]) -> bool:
    """Whether rows of a chunk were played."""
    return any(episode["schedule"].get(f"{level}_ticks", 0) > 0 for level in ("play", "stale"))


@contextmanager
def place_for(place: Place) -> Iterator[tuple[Rig, Path]]:
    """A rig whose logs go to a file system of their own, ``disk`` in its folder."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))
        disk = folder / "disk"
        disk.mkdir()
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64m", "faults", disk], check=True)
        stack.callback(lambda: subprocess.run(["umount", "--lazy", disk], check=True))
        if place == "faketime":
            (folder / "time").write_text("+0\n")
            faked = {
                "LD_PRELOAD": str(_FAKETIME),
                "FAKETIME_TIMESTAMP_FILE": str(folder / "time"),
                "FAKETIME_NO_CACHE": "1",
                "FAKETIME_DONT_FAKE_MONOTONIC": "1",
            }
            os.environ.update(faked)
            stack.callback(lambda: [os.environ.pop(name) for name in faked])
        rig = stack.enter_context(Rig(folder, proxied=place == "tcp", allow_starved=True))
        stack.callback(_thaw, rig)
        yield rig, folder


def _thaw(rig: Rig) -> None:
    for process in rig.daemons.processes.values():
        process.send_signal(signal.SIGCONT)


def rounds(options: FaultsOptions) -> Iterator[tuple[Place, list[Trial]]]:
    """The trials by the rig that they need, a few at a time."""
    trials = [Trial(index=i, fault=draw(options.seed, i)) for i in range(options.first, options.first + options.trials)]
    waiting: dict[Place, list[Trial]] = {"unix": [], "tcp": [], "faketime": []}
    for trial in trials:
        same = waiting[trial.fault.place]
        same.append(trial)
        if len(same) == _TRIALS_OF_A_RIG:
            yield trial.fault.place, list(same)
            same.clear()
    yield from ((place, left) for place, left in waiting.items() if left)


def row_of(name: str, trials: list[Trial]) -> Row:
    logs = Counter(log for trial in trials for log in trial.logs)
    return {
        "fault": name,
        "trials": len(trials),
        "logs": sum(logs.values()),
        "whole, agree": logs["whole"],
        "cut and said so, agree": logs["cut"],
        "not recorded and said so": logs["not recorded"],
        "wrong logs": logs["wrong"],
        "wrong outcomes": sum(bool(trial.wrong) for trial in trials),
    }


def tables(report: Report, done: list[Trial]) -> None:
    by_kind = [(kind, [t for t in done if t.fault.kind == kind]) for kind in KINDS]
    report.add_table("By kind", [row_of(kind, trials) for kind, trials in by_kind if trials] + [row_of("all", done)])
    by_moment = [(moment, [t for t in done if t.fault.moment == moment]) for moment in MOMENTS]
    report.add_table("By moment", [row_of(moment, trials) for moment, trials in by_moment if trials])
    ends: Counter[tuple[str, str, str]] = Counter()
    for trial in done:
        for end in trial.ends[:1]:
            reason = "".join("#" if letter.isdigit() else letter for letter in end)[:100]
            ends[trial.fault.kind, "+".join(trial.fault.victims), reason] += 1
    report.add_table(
        "How the struck episodes ended",
        [{"fault": kind, "struck": who, "end": end, "n": n} for (kind, who, end), n in sorted(ends.items())],
    )
    report.notes += [f"wrong, trial {t.index} {_named(t.fault)}: {sentence}" for t in done for sentence in t.wrong]


def _named(fault: Fault) -> str:
    return f"{fault.kind} {'+'.join(fault.victims)} {fault.moment} for {fault.seconds:.1f} s"


@command("faults")
def main(argv: list[str] | None = None) -> int:
    options = parse(FaultsOptions, argv, prog="python -m benchmarks.faults")
    if _OWN_NAMESPACE not in os.environ:  # so that no other process meets a full /dev/shm
        os.environ[_OWN_NAMESPACE] = "1"
        words = [sys.executable, "-m", "benchmarks.faults", *(sys.argv[1:] if argv is None else argv)]
        os.execvp("unshare", ["unshare", "--mount", *words])
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=512m", "faults", "/dev/shm"], check=True)
    report = Report(
        name="faults",
        question="Does any fault spoil a log, move the robot, or keep a healthy server from coming back?",
        config=options,
        warm_up="none: opening is one of the moments",
    )
    done: list[Trial] = []
    deadline_s = time.monotonic() + 60 * options.minutes
    for place, trials in rounds(options):
        if time.monotonic() > deadline_s:
            break
        if place == "faketime" and not _FAKETIME.exists():
            report.notes.append(f"{len(trials)} trials left out: libfaketime is not installed")
            continue
        with place_for(place) as (rig, folder):
            for trial in trials:
                if time.monotonic() > deadline_s:
                    break
                run(trial, rig, folder, options)
                done.append(trial)
                print(json.dumps(dataclasses.asdict(trial)), flush=True)
    tables(report, done)
    report.notes += [
        "whole: closed, with its result, and pp-check derives it again. cut: pp-check names where and why it ends, and "
        "agrees with what is there; only where the robot's process or its disk was struck. After every trial the next "
        "episode has to play rows of a chunk.",
        "cpu_starved: a process may run for 20 ms of every 100. wall_clock_jumped: by up to a day, with libfaketime. "
        "folder_read_only: no file can be made or renamed (chattr +i). disk_full and shm_full: up to 1 MiB is left.",
    ]
    if options.report:
        report.write()
    show(report)
    return int(any(trial.wrong for trial in done))


if __name__ == "__main__":
    sys.exit(main())
