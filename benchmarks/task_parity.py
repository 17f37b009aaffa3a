"""Parity of our tasks with the public benchmark's: each is played in the scene of a recorded episode and compared.

Our oracle's episode: goal, ordered texts of video and execution, length. Our simulation under the recorded actions:
texts and coordinates of the execution, and the poses of scripted objects at every step until the last one rests.
(Coordinates are fixed when an object is first visible; under other actions the arm may occlude it at that moment.)
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.recorded import Recording, layout_of, read, recorded_tasks
from benchmarks.report import Report, Row, show
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot, make_environment
from protocol.command_line import parse

MAX_LENGTH_OFF, MAX_PX, MAX_M = 0.2, 4, 0.005

_ALIASES = {"moving_cube": "shuttle"}
_SCRIPTED = ("container_", "moving_cube")  # objects moved by time alone; VideoRepick's cubes also wait for the arm
_OUT_OF_SIGHT_M = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ParityOptions:
    """Our tasks beside recorded episodes of the public benchmark."""

    recordings: Path
    """Folder of ``<Task>_train006.json`` and ``.npz``."""
    tasks: tuple[str, ...] = ()
    """Names of the tasks. Empty: all that are recorded."""


def compare(env: Environment, recording: Recording) -> Row:
    """One row of the table."""
    facts = recording.facts
    layout = layout_of(recording.task)
    if layout is None:
        return {"task": recording.task, "is_same": "no scene"}
    first = env.reset(facts["seed"], facts["difficulty"], layout=layout)
    same_goal = env.instruction == facts["goals"][0]
    video = texts(env.demonstration())
    snapshots = played(env, first, env.oracle())
    first = env.reset(facts["seed"], facts["difficulty"], layout=layout)
    ours = {"demo": video, "exec": texts(played(env, first, recording.arrays["exec_action"]))}
    theirs = {phase: [entry for entry in facts["subgoals"] if entry["phase"] == phase] for phase in ours}
    same_texts = all([plain for plain, _ in ours[p]] == [entry["simple_subgoal"] for entry in theirs[p]] for p in ours)
    same_texts &= without_repeats(s.simple_subgoal for s in snapshots) == without_repeats(
        entry["simple_subgoal"] for entry in theirs["exec"]
    )
    apart_px = [
        px
        for phase in ours
        for (_, said), entry in zip(ours[phase], theirs[phase], strict=False)
        for px in apart(said, entry["grounded_subgoal"])
    ]
    length_off = snapshots[-1].step / facts["exec_steps"] - 1
    drift_m = drift(env, recording, layout)
    is_same = (
        same_goal
        and same_texts
        and snapshots[-1].status is Status.SUCCESS
        and abs(length_off) <= MAX_LENGTH_OFF
        and max(apart_px, default=0) <= MAX_PX
        and (drift_m is None or drift_m <= MAX_M)
    )
    return {
        "task": recording.task,
        "is_same": "yes" if is_same else "NO",
        "oracle": snapshots[-1].status.value,
        "goal": "same" if same_goal else "other",
        "texts": f"{len(ours['demo']) + len(ours['exec'])} {'same' if same_texts else 'other'}",
        "steps_ours": snapshots[-1].step,
        "steps_recorded": facts["exec_steps"],
        "length_off_%": round(100 * length_off, 1),
        "video_ours": sum(1 for _ in env.demonstration()),
        "video_recorded": facts["demo_frames"],
        "coordinates": len(apart_px),
        "worst_px": max(apart_px, default=None),
        "worst_drift_mm": None if drift_m is None else round(1e3 * drift_m, 2),
    }


def played(env: Environment, first: Snapshot, actions: Iterable[NDArray[np.float32]]) -> list[Snapshot]:
    """Snapshots under the given actions until the episode ends."""
    snapshots = [first]
    for action in actions:
        snapshots.append(env.step(action))
        if snapshots[-1].status is not Status.ONGOING:
            break
    return snapshots


def without_repeats(said: Iterable[str]) -> list[str]:
    """The texts in order, without consecutive repeats."""
    return [text for text, _ in groupby(said)]


def texts(snapshots: Iterable[Snapshot]) -> list[tuple[str, str]]:
    """Plain and grounded text at each change."""
    changes: list[tuple[str, str]] = []
    for snapshot in snapshots:
        said = (snapshot.simple_subgoal, snapshot.grounded_subgoal)
        if changes[-1:] != [said]:
            changes.append(said)
    return changes


def apart(ours: str, theirs: str) -> list[int]:
    """Differences between the coordinates of two texts, in pixels, for as many as both have."""
    numbers = ([int(n) for n in re.findall(r"\d+", " ".join(re.findall(r"<[^>]*>", text)))] for text in (ours, theirs))
    return [abs(a - b) for a, b in zip(*numbers, strict=False)]


def drift(env: Environment, recording: Recording, layout: object) -> float | None:
    """Largest distance of scripted objects from their recorded poses, in metres; None if there are none."""
    names = [str(name) for name in recording.arrays["object_names"]]
    moved = [name for name in names if name.startswith(_SCRIPTED)]
    if not moved:
        return None
    env.reset(recording.facts["seed"], recording.facts["difficulty"], layout=layout)
    start = env.save()
    worst_m = 0.0
    columns = [names.index(name) for name in moved]
    for row, theirs in zip(start.video, recording.arrays["demo_object_poses"], strict=False):
        env.physics.load(row.physics)
        worst_m = max(worst_m, farthest_m(env, moved, theirs[columns]))
    env.restore(start)
    last_step = getattr(layout, "last_event_step", None)
    for action, theirs in zip(recording.arrays["exec_action"], recording.arrays["object_poses"], strict=True):
        worst_m = max(worst_m, farthest_m(env, moved, theirs[columns]))
        done = env.step(action).status is not Status.ONGOING
        if done or (last_step is not None and env.physics.elapsed_steps() > last_step):
            break
    return worst_m


def farthest_m(env: Environment, names: Sequence[str], theirs: NDArray[np.float32]) -> float:
    """Largest distance of an object from its recorded pose (n, 7); objects out of sight in both do not count."""
    worst_m = 0.0
    for name, pose in zip(names, theirs, strict=True):
        ours_m = env.physics.position_m(_ALIASES.get(name, name))
        is_away = not np.isfinite(pose).all() or np.abs(pose[:3]).max() > _OUT_OF_SIGHT_M
        if is_away and np.abs(ours_m).max() > _OUT_OF_SIGHT_M:
            continue
        worst_m = max(worst_m, float("inf") if is_away else float(np.linalg.norm(ours_m - pose[:3])))
    return worst_m


def main(argv: list[str] | None = None) -> int:
    options = parse(ParityOptions, argv, prog="task-parity")
    report = Report(
        name="task_parity",
        question="Are our tasks the public benchmark's? One recorded episode of each, in the same scene.",
        config=options,
        warm_up="nothing; these numbers do not depend on the machine's speed.",
    )
    rows: list[Row] = []
    for task in options.tasks or recorded_tasks(options.recordings):
        with make_environment(task, render=False) as env:
            rows.append(compare(env, read(task, options.recordings)))
            print(rows[-1], flush=True)
    complete = [row for row in rows if len(row) > 2]
    report.add_table("Our tasks in recorded scenes", complete)
    report.notes += [f"{row['task']}: no test places its recorded scene yet." for row in rows if len(row) == 2]
    report.notes.append(
        f"Same means: goal and ordered texts to the letter, the oracle succeeds, its length within "
        f"{MAX_LENGTH_OFF:.0%}, coordinates within {MAX_PX} px, scripted things within {1e3 * MAX_M:g} mm. "
        "The cubes that VideoRepick swaps wait for the arm: its tests compare them, at every step."
    )
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0 if all(row["is_same"] == "yes" for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
