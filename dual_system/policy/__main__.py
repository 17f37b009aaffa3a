"""``make policy``: trains the laptop pair from nothing, in slices of some minutes; a killed or ended slice is resumed.

    python -m dual_system.policy --folder POLICY_DIR --minutes 150

A stage is a set of commands that run side by side, each of which resumes by itself, and the files that it leaves. The
first stage that lacks one of its files is run, until the slice is over or there is none left. What each stage has cost
is added to ``hours.jsonl``, of which a table is printed at the end.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dual_system.analysis.markdown import markdown
from dual_system.training.recipes import laptop as laptop_joint
from dual_system.training.recipes import laptop_grounding, laptop_hand
from protocol.command_line import command, parse

TASKS = ("VideoUnmask", "PickHighlight", "MoveCube", "PickXtimes")
EPISODES, STILLS, TOWER_MINUTES = 300, 12_000, 60
_ENDING_S = 120.0
"""What a command is given to save its state when a slice ends."""
DONE, UNFINISHED, FAILED = 0, 3, 1


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyOptions:
    """Trains the laptop pair; the same command goes on where the last slice ended (exit code 3: there is more)."""

    folder: Path
    """Where data, checkpoints and the account of hours are kept: tens of gigabytes, outside of the checkout."""
    minutes: float = 150.0
    """Length of this slice."""
    only: tuple[str, ...] = ()
    """Stages to run, by name; () for all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """Commands that run side by side, and what is there when they are done."""

    name: str
    commands: tuple[tuple[str, ...], ...]
    leaves: tuple[Path, ...]

    @property
    def is_done(self) -> bool:
        return all(path.exists() for path in self.leaves)


def stages(folder: Path) -> tuple[Stage, ...]:
    """The stages in their order; each starts from what those before it left."""
    sets = {task: folder / "data" / task for task in TASKS}
    data = tuple(map(str, sets.values()))
    towers, hand, grounded, joint = (folder / name for name in ("towers", "hand", "grounding", "joint"))
    locating = ("dual_system.policy.towers", "--out", f"{towers}", "--stills", f"{STILLS}")
    training = ("dual_system.training.train", "--picture-store", f"{folder / 'pictures'}", "--data", *data)
    obeying = ("--recipe", laptop_hand.__name__, *_from(towers, towers), "--out", f"{hand}")
    wording = ("--recipe", laptop_grounding.__name__, *_from(towers, towers), "--out", f"{grounded}")
    together = ("--recipe", laptop_joint.__name__, *_from(grounded, hand), "--out", f"{joint}")
    systems = ("ponder", "pounce")
    return (
        *(
            Stage(name=f"data {task}", commands=(_collect(task, out),), leaves=(out / "meta",))
            for task, out in sets.items()
        ),
        Stage(name="album", commands=((*locating, "--minutes", "0"),), leaves=(towers / "album.npz",)),
        Stage(
            name="towers",
            commands=tuple((*locating, "--minutes", f"{TOWER_MINUTES}", "--trains", system) for system in systems),
            leaves=tuple(towers / f"{system}.done" for system in systems),
        ),
        Stage(
            name="pretrained",
            commands=((*locating, "--minutes", "0", "--data", *data),),
            leaves=tuple(towers / system for system in systems),
        ),
        Stage(
            name="hand and words",
            commands=((*training, *obeying), (*training, *wording)),
            leaves=(hand / "pounce", grounded / "ponder"),
        ),
        Stage(name="joint", commands=((*training, *together),), leaves=tuple(joint / system for system in systems)),
    )


def _from(ponder: Path, pounce: Path) -> tuple[str, ...]:
    return "--ponder", f"{ponder / 'ponder'}", "--pounce", f"{pounce / 'pounce'}"


def _collect(task: str, out: Path) -> tuple[str, ...]:
    pictures = ("--image-px", "128", "--frames", "training", "--invocation-hz", "10", "--demonstration-hz", "2")
    content = ("--noise", "dart", "--texts", "follow", "--shove-share", "0.4", "--recovery-share", "0.15")
    amount = ("--tasks", task, "--episodes", f"{EPISODES}", "--difficulties", "easy", "medium", "hard")
    return "dual_system.data.collect", "--out", f"{out}", *amount, *pictures, *content, "--no-progress"


@command("policy")
def main(argv: list[str] | None = None) -> int:
    options = parse(PolicyOptions, argv, prog="python -m dual_system.policy")
    folder = options.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    ends_s = time.monotonic() + 60 * options.minutes
    for stage in stages(folder):
        if stage.is_done or (options.only and stage.name.split()[0] not in options.only):
            continue
        code = _run(stage, folder, ends_s)
        if code or time.monotonic() >= ends_s:
            sys.stdout.write(account(folder))
            return code or (DONE if all(each.is_done for each in stages(folder)) else UNFINISHED)
    sys.stdout.write(account(folder))
    return DONE


def _run(stage: Stage, folder: Path, ends_s: float) -> int:
    """Runs a stage until it is done or the slice is over; adds its cost to the account."""
    sys.stdout.write(f"--- {stage.name}\n")
    sys.stdout.flush()
    before, began_s = _core_s(), time.monotonic()
    processes = [
        subprocess.Popen([sys.executable, "-m", *each], env=os.environ | {"OMP_NUM_THREADS": "1"})
        for each in stage.commands
    ]
    try:
        codes = [_ended(process, ends_s) for process in processes]
    finally:
        for process in processes:
            process.kill()
    entry = {"stage": stage.name, "wall_s": time.monotonic() - began_s, "core_s": _core_s() - before}
    with (folder / "hours.jsonl").open("a") as file:
        file.write(json.dumps(entry) + "\n")
    is_over = time.monotonic() >= ends_s
    if any(codes) and not is_over:
        sys.stderr.write(f"policy: {stage.name} ended with {codes}; what it printed says why\n")
        return FAILED
    return DONE


def _ended(process: subprocess.Popen[bytes], ends_s: float) -> int:
    """Waits for a command; at the end of the slice it is told to (by SIGTERM: nohup shields from Ctrl-C) and saves."""
    try:
        return process.wait(max(0.0, ends_s - time.monotonic()))
    except subprocess.TimeoutExpired:
        process.terminate()
    try:
        return process.wait(_ENDING_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def _core_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


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


if __name__ == "__main__":
    sys.exit(main())
