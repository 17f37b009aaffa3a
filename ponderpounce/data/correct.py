"""``pp-correct``: recorded episodes, acted out again up to some tick, from which the oracle goes on.

What a policy gets itself into, with what should be done there (DAgger, Ross et al. 2011; the expert keeps the arm once
it has it, as in HG-DAgger, Kelly et al. 2019). A seed decides the scene and the physics repeats itself bit for bit, so
a log of actions is all that is needed: no server runs. Rows before `About.corrected_from` are the policy's doing, for
PONDER to follow; POUNCE imitates the others.

A log is corrected at several ticks, one drawn from each equal part of it, so a policy that was stuck for long is
corrected often where it was stuck. Grasps go on from where the tool is (`Motions`, ``resumes``). Whatever else the
oracle was called into it begins anew, which nobody should imitate: there corrected rows begin with the next subtask.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from tqdm import tqdm

import ponderpounce.tasks.headless  # noqa: F401 - before mujoco is imported
from ponderpounce.data.episode import About, EpisodeWriter, Package, unpack
from ponderpounce.data.errors import DatasetError
from ponderpounce.data.export import texts_by_tick
from ponderpounce.data.jobs import Look
from ponderpounce.data.lerobot_v3 import INFO_PATH, DatasetWriter
from ponderpounce.data.rollout import Scribe, UnsolvedError, asked, check_solved, kept_environment
from ponderpounce.data.workers import LocalWorkers, Workers
from ponderpounce.tasks.engine import Status
from ponderpounce.tasks.environment import Environment, Snapshot
from ponderpounce.tasks.kinematics import UnreachableError
from ponderpounce.tasks.oracle import Motions
from ponderpounce.tasks.task import TaskError
from protocol.errors import ProtocolError
from protocol.mcap_log import EpisodeRecord, read_log

DONE, REFUSED = 0, 2
_TAKE_OVER_STREAM = 4  # of a seed's random numbers; the scene, failed grasps and noise draw from others


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectOptions:
    """Makes a dataset of recorded episodes that the oracle takes over. The same command gives the same dataset."""

    files: tyro.conf.Positional[tuple[Path, ...]]
    """MCAP logs of sim-client or pp-eval, of lockstep episodes; pictures need not be in them."""
    out: Path
    """Folder of the new dataset."""
    per_episode: int = 2
    """Episodes made of each log, each taken over elsewhere."""
    look_hz: Literal[1, 2, 4, 5, 10, 20] = 5
    """How often pictures are rendered."""
    image_px: int = 256
    """Even; the paper's and the benchmark's is 256."""
    max_steps: int = 1300
    """An episode that takes longer is not kept."""
    workers: int = os.cpu_count() or 1
    """Processes of this computer."""
    progress: Annotated[bool, tyro.conf.FlagCreatePairsOff] = True
    """Show a progress bar."""

    def __post_init__(self) -> None:
        if self.per_episode < 1 or self.workers < 1:
            raise ValueError(f"per_episode and workers must be at least 1, came {self.per_episode} and {self.workers}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One episode to make."""

    path: Path
    part: int
    """Of the log, from 0: which of ``per_episode`` equal parts it is taken over in."""
    options: CorrectOptions

    @property
    def key(self) -> str:
        return f"{self.path}/{self.part}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What became of a job."""

    package: Package | None
    reason: str = ""
    """Why there is no package."""


def main(argv: list[str] | None = None) -> int:
    try:
        options = tyro.cli(CorrectOptions, args=argv, prog="pp-correct", description=CorrectOptions.__doc__)
        reasons = correct(options, LocalWorkers(options.workers, work_out))
    except (DatasetError, ProtocolError, TaskError, OSError, ValueError) as error:
        sys.stderr.write(f"pp-correct: {error}\n")
        return REFUSED
    num_jobs = len(options.files) * options.per_episode
    sys.stdout.write(f"{num_jobs - len(reasons)} episodes of {len(options.files)} logs in {options.out}\n")
    for reason in sorted(set(reasons)):
        sys.stdout.write(f"  {reasons.count(reason)} not kept: {reason}\n")
    return DONE


def correct(options: CorrectOptions, workers: Workers[Job, Outcome]) -> list[str]:
    """Writes the dataset, log by log; returns why each episode that is not in it was not kept.

    Raises:
        DatasetError: there is a dataset already, nothing is left to write, or a log cannot be acted out.
        OSError, ProtocolError: a log cannot be read.
        TaskError: a log of a task that does not exist here.
    """
    if (options.out / INFO_PATH).exists():
        raise DatasetError(f"{options.out} holds a dataset already; use another --out")
    jobs = [Job(path=path, part=part, options=options) for path in options.files for part in range(options.per_episode)]
    bar = tqdm(total=len(jobs), unit="episode", disable=not options.progress)
    writer = DatasetWriter(options.out)
    reasons = []
    num_written = 0
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
    """Outcomes in the jobs' order, whatever order they come in."""
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
    actions = _actions(job.path, record)
    options = job.options
    environment = kept_environment(  # coordinates follow what is pushed, as for the hand that pushed it
        record.info.task, options.image_px, options.max_steps, texts_follow=True
    )
    writer = EpisodeWriter(options.image_px)
    scribe = Scribe(environment, writer.add, Look(execution_hz=options.look_hz))
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
    """What was commanded at ticks 0, 1, 2 ...; raises DatasetError if one is missing."""
    done = {each.tick: each.action for each in record.ticks}
    missing = next((tick for tick in range(len(done)) if tick not in done), None)
    if missing is not None or not done:
        raise DatasetError(
            f"{path}: the log lacks the account of tick {missing or 0}; episodes with gaps cannot be repeated"
        )
    return [done[tick] for tick in range(len(done))]


def _taken_over_at(seed: int, part: int, num_parts: int, num_ticks: int) -> int:
    """A tick of one of the equal parts of an episode."""
    drawn = np.random.default_rng((seed, _TAKE_OVER_STREAM, part)).random()
    return int((part + drawn) / num_parts * num_ticks)


def _acted_out(
    path: Path, record: EpisodeRecord, scribe: Scribe, first: Snapshot, actions: Sequence[np.ndarray]
) -> Snapshot:
    """The world after these actions.

    Raises:
        DatasetError: it is not the one that the log tells of, or something else is to be done in it.
        UnsolvedError: no time is left there.
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
    if text != snapshot.simple_subgoal:
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
    """So that reasons of one kind are counted together."""
    return " ".join(word for word in reason.split() if not any(letter.isdigit() for letter in word))


if __name__ == "__main__":
    sys.exit(main())
