"""``pp-collect correct``: policy rollouts, replayed up to a tick, from which the oracle takes over (DAgger).

The dataset holds the states that a policy visits and the oracle's actions from there on (Ross et al. 2011; as in
HG-DAgger, Kelly et al. 2019, the expert keeps control once it has it). A seed decides the scene and the physics repeats
bit for bit, so a log of actions is enough and no server runs. Rows before `About.corrected_from` are the policy's own:
PONDER reads them, POUNCE imitates only the others.

A log is corrected at several ticks, one drawn from each of its equal parts, so a policy that was stuck for long is
corrected often where it was stuck. Grasps resume from where the tool is (`Motions`, ``resumes``). Any other motion the
oracle restarts from its beginning, which should not be imitated: there the corrected rows begin with the next subtask.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from tqdm import tqdm

import dual_system.tasks.headless  # noqa: F401 - before mujoco is imported
from dual_system.data.episode import About, EpisodeWriter, Package, unpack
from dual_system.data.errors import DatasetError
from dual_system.data.export import refuse_split, texts_by_tick
from dual_system.data.jobs import Look
from dual_system.data.lerobot_files import INFO_PATH
from dual_system.data.lerobot_v3 import DatasetWriter
from dual_system.data.recorded import logs_in
from dual_system.data.rollout import Scribe, UnsolvedError, asked, check_solved, kept_environment
from dual_system.data.video import check_image_px
from dual_system.data.workers import LocalWorkers, Workers
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Environment, Snapshot
from dual_system.tasks.kinematics import UnreachableError
from dual_system.tasks.oracle import Motions
from dual_system.tasks.seeds import UNTRAINED
from protocol import files
from protocol.command_line import On, command, parse
from protocol.mcap_log import EpisodeRecord, read_log

DONE, REFUSED = 0, 2
_TAKE_OVER_STREAM = 4  # of a seed's random numbers; the scene, failed grasps and noise draw from others


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectOptions:
    """Makes a dataset of recorded episodes that the oracle takes over. The same command gives the same dataset."""

    files: tyro.conf.Positional[tuple[Path, ...]]
    """MCAP logs of lockstep episodes, made by sim-client or pp-eval, or folders of them; they need no pictures."""
    out: Path
    """Folder of the new dataset."""
    per_episode: int = 2
    """Number of corrected episodes per log, each taken over at another tick."""
    record_hz: Literal[1, 2, 4, 5, 10, 20] = 5
    """Rate of rendered pictures in Hz."""
    image_px: int = 256
    """Side of the pictures in pixels, an even number (paper and benchmark: 256)."""
    max_steps: int = 1300
    """Limit of control steps per episode; longer episodes are not kept."""
    workers: int = os.cpu_count() or 1
    """Number of worker processes on this computer."""
    progress: On = True
    """Do not show a progress bar."""

    def __post_init__(self) -> None:
        if self.per_episode < 1 or self.workers < 1:
            raise ValueError(f"per_episode and workers must be at least 1, came {self.per_episode} and {self.workers}")
        check_image_px(self.image_px)


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One episode to make."""

    path: Path
    part: int
    """Index, from 0, of the one of ``per_episode`` equal parts of the log in which the oracle takes over."""
    options: CorrectOptions

    @property
    def key(self) -> str:
        return f"{self.path}/{self.part}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """The result of a job."""

    package: Package | None
    reason: str = ""
    """The reason if there is no package."""


@command("pp-collect correct")
def main(argv: list[str] | None = None, prog: str = "pp-collect correct") -> int:
    options = parse(CorrectOptions, argv, prog=prog)
    reasons = correct(options, LocalWorkers(options.workers, work_out))
    num_logs = len(logs_in(options.files))
    num_kept = num_logs * options.per_episode - len(reasons)
    sys.stdout.write(f"{num_kept} episodes of {num_logs} logs in {options.out}\n")
    for reason in sorted(set(reasons)):
        sys.stdout.write(f"  {reasons.count(reason)} not kept: {reason}\n")
    return DONE


def correct(options: CorrectOptions, workers: Workers[Job, Outcome]) -> list[str]:
    """Writes the dataset, log by log; returns why each episode that is not in it was not kept.

    Raises:
        DatasetError: there is a dataset already, nothing is left to write, or a log cannot be acted out or is of a
            scene that nothing is trained on.
        OSError, ProtocolError: a log cannot be read.
        TaskError: a log of a task that does not exist here.
    """
    if (options.out / INFO_PATH).exists():
        raise DatasetError(f"{options.out} holds a dataset already; use another --out")
    jobs = [
        Job(path=path, part=part, options=options)
        for path in logs_in(options.files)
        for part in range(options.per_episode)
    ]
    bar = tqdm(total=len(jobs), unit="episode", disable=not options.progress)
    writer = DatasetWriter(files.folder(options.out))
    reasons = []
    num_written = 0
    with files.writing(options.out):
        for outcome in _in_order(jobs, workers):
            bar.update()
            if outcome.package is None:
                reasons.append(outcome.reason)
            else:
                writer.add(unpack(outcome.package))
                num_written += 1
        bar.close()
        if not num_written:
            raise DatasetError(f"no episode was left to write: {'; '.join(sorted(set(reasons)))}")
        writer.finish()
    return reasons


def _in_order(jobs: Sequence[Job], workers: Workers[Job, Outcome]) -> Iterator[Outcome]:
    """Yields outcomes in the jobs' order, as workers finish them in any order."""
    early: dict[str, Outcome] = {}
    expected = iter(jobs)
    awaited = next(expected, None)
    for job, outcome in workers.run(jobs):
        early[job.key] = outcome
        while awaited is not None and awaited.key in early:
            yield early.pop(awaited.key)
            awaited = next(expected, None)


def work_out(job: Job) -> Outcome:
    """Makes one episode. Raises as `correct` does."""
    record = read_log(job.path)
    refuse_split(job.path, record.info, UNTRAINED)
    actions = _actions(job.path, record)
    options = job.options
    environment = kept_environment(  # the policy may have pushed objects: coordinates follow them
        record.info.task, options.image_px, options.max_steps, texts_follow=True
    )
    writer = EpisodeWriter(options.image_px)
    scribe = Scribe(environment, writer.add, Look(execution_hz=options.record_hz))
    first = environment.reset(record.info.seed, record.info.difficulty)
    scribe.begin()
    at = _taken_over_at(record.info.seed, job.part, options.per_episode, len(actions))
    try:
        snapshot = _acted_out(job.path, record, scribe, first, actions[:at])
        corrected_from = _take_over(environment, scribe, snapshot)
    except (UnsolvedError, UnreachableError) as error:
        return Outcome(package=None, reason=_without_numbers(str(error)))
    if corrected_from is None:
        return Outcome(package=None, reason="the last subtask had begun, and is none that the oracle goes on with")
    about = About(
        task=record.info.task,
        instruction=environment.instruction,
        seed=record.info.seed,
        difficulty=environment.difficulty,
        origin=f"{record.info.policy}, corrected",
        is_success=True,
        image_px=options.image_px,
        corrected_from=corrected_from,
    )
    return Outcome(package=writer.pack(about))


def _actions(path: Path, record: EpisodeRecord) -> list[np.ndarray]:
    """Returns the actions of ticks 0, 1, 2 ...; raises DatasetError if one is missing."""
    done = {each.tick: each.action for each in record.ticks}
    missing = next((tick for tick in range(len(done)) if tick not in done), None)
    if missing is not None or not done:
        raise DatasetError(
            f"{path}: the log lacks the account of tick {missing or 0}; episodes with gaps cannot be repeated"
        )
    return [done[tick] for tick in range(len(done))]


def _taken_over_at(seed: int, part: int, num_parts: int, num_ticks: int) -> int:
    """Draws a tick from one of the equal parts of an episode."""
    drawn = np.random.default_rng((seed, _TAKE_OVER_STREAM, part)).random()
    return int((part + drawn) / num_parts * num_ticks)


def _acted_out(
    path: Path, record: EpisodeRecord, scribe: Scribe, first: Snapshot, actions: Sequence[np.ndarray]
) -> Snapshot:
    """Replays these actions and returns what is seen afterwards.

    Raises:
        DatasetError: the state or the subgoal differs from the log's.
        UnsolvedError: no time is left.
    """
    snapshot = first
    for action in actions:
        if snapshot.status is not Status.ONGOING:
            break
        snapshot = scribe.step(snapshot, action)
    if snapshot.status is Status.TIMEOUT:
        raise UnsolvedError(f"the log goes on beyond --max-steps: {snapshot.reason}")
    logged = {each.tick: each.proprio for each in record.observations}.get(len(actions))
    if logged is None or not np.array_equal(logged, snapshot.state) or snapshot.status is not Status.ONGOING:
        raise DatasetError(
            f"{path}: after {len(actions)} ticks the robot stands at {snapshot.state.tolist()} here "
            f"({snapshot.status.value}) and at {None if logged is None else logged.tolist()} in the log, which was "
            f"made with {record.info.versions}; correct it with those versions"
        )
    text, _, _ = texts_by_tick(record.subgoals, len(actions) + 1)[-1]
    has_gone_back = snapshot.subgoal_index != snapshot.subtask_index  # here to the grasp of what was dropped; not there
    if not has_gone_back and text != snapshot.simple_subgoal:
        raise DatasetError(
            f"{path}: after {len(actions)} ticks the subgoal is {snapshot.simple_subgoal!r} here and {text!r} in the "
            f"log, which was made with {record.info.versions}; correct it with those versions"
        )
    return snapshot


def _take_over(environment: Environment, scribe: Scribe, snapshot: Snapshot) -> int | None:
    """The oracle solves the rest; returns the first step to be imitated, None if there is none.

    Raises UnsolvedError or UnreachableError.
    """
    motions = Motions(environment.physics, resumes=True)
    script = environment.oracle(motions)
    begun = snapshot.subgoal_index
    corrected_from = None
    while snapshot.status is Status.ONGOING:
        action = asked(script, snapshot)
        if corrected_from is None and (motions.has_resumed or snapshot.subgoal_index != begun):
            corrected_from = snapshot.step
        snapshot = scribe.step(snapshot, action)
    check_solved(snapshot)
    return corrected_from


def _without_numbers(reason: str) -> str:
    """Drops words with digits, so that reasons of one kind are counted together."""
    return " ".join(word for word in reason.split() if not any(letter.isdigit() for letter in word))


if __name__ == "__main__":
    sys.exit(main())
