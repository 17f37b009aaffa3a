"""``pp-eval``: the paper's evaluation (B.1) of one condition: every task, the same scenes in several runs.

An evaluation is a set of independent episodes. A worker that has loaded its servers once plays each in lockstep, and
its result is written as soon as it ends (`Ledger`). The same command resumes a killed evaluation: no episode is played
twice or lost, and ``results.json`` equals that of an undisturbed evaluation.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tqdm import tqdm

import dual_system.tasks.headless  # noqa: F401 - before anything that imports mujoco

# isort: split

from dual_system.data.errors import DatasetError
from dual_system.data.seeds import TRAIN_SEED
from dual_system.data.workers import LocalWorkers, RayWorkers, Workers
from dual_system.tasks.difficulty import Difficulty
from dual_system.tasks.environment import Environment, make_environment
from dual_system.tasks.task import TaskError, chosen_tasks
from protocol.bus import Bus
from protocol.errors import TransportError
from protocol.link import Link
from protocol.process import set_up_logging
from sim_client.config import SimOptions
from sim_client.harness import BuildServer, ServerStep, open_harness
from sim_client.launch import Daemons
from sim_client.ledger import Ledger, LedgerError, write_json
from sim_client.null_ponder import NullPonder, cognition_shape
from sim_client.suite import Suite, as_json, versions
from sim_client.swapped_ponder import DonorError, SwappedPonder, donors_in

DONE, REFUSED, INTERRUPTED = 0, 2, 130
Line = dict[str, Any]  # one episode's entry in results.json

_HOW_MANY = ("tasks", "episodes", "runs")  # a folder may be given more of them later
_HOW = ("out", "patience_s", "progress")  # and these change no result


class EvaluationError(Exception):
    """An evaluation that cannot be made: the message says what was expected, what came, and the way out."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvalOptions:
    """Evaluates a pair of checkpoints as the paper does. The same command again resumes a killed evaluation."""

    out: Path
    """Folder of one condition: results.json, and with --record one MCAP per episode."""
    tasks: tuple[str, ...] = ("all",)
    """Names of the tasks, or `all`. sim-client --list-tasks shows them."""
    episodes: int = 50
    """Number of scenes per task (paper: 50)."""
    runs: int = 3
    """Number of times that every scene is played, each with other flow noise (paper: 3)."""
    seed: int = 0
    """Seed of the first scene; all must lie below 2,000,000, where the training seeds begin."""
    difficulty: Difficulty | None = None
    """Difficulty of every scene. None: by seed, as the benchmark does."""
    policy: Literal["servers", "oracle"] = "servers"
    """Source of actions: the servers, or the tasks' own scripts (oracle), to test the machine."""
    ponder_checkpoint: Path | None = None
    """PONDER's checkpoint. None: random weights."""
    pounce_checkpoint: Path | None = None
    """POUNCE's checkpoint. None: random weights."""
    max_steps: int = 1300
    """Limit of control steps per episode (paper: 1300)."""
    demo_hz: Literal[1, 2, 4, 5, 10, 20] | None = None
    """How many frames of a demonstration are shown a second. None: as many as the --ponder-checkpoint says that it has
    learned from; without one, the paper's 1."""
    video_end: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show a demonstration's last frame, too, although the --ponder-checkpoint does not say that it has learned so."""

    cognition: Literal["real", "null", "other-episode"] = "real"
    """Cognition that POUNCE is conditioned on. real: PONDER's; null: the learned null; other-episode: PONDER's in
    another episode of the task."""
    donors: Path | None = None
    """Folder (--out) of a recorded evaluation of the same scenes with real cognition, for --cognition other-episode."""
    subgoal_text: Literal["ponder", "oracle"] | None = None
    """Subgoal texts for a POUNCE that reads them in place of cognition: PONDER's, or the task's. Others refuse it."""
    deliver: Literal["every", "held-transition"] = "every"
    """Delivery of cognition. held-transition: only the first, then those at predicted transitions (paper, 5.2)."""
    reported_age_ms: int = 0
    """Age in ms given to POUNCE with --deliver held-transition; 0 is the true age. The paper fixes it at 300."""
    query_period_ms: int = 1000
    """Period of PONDER's queries in ms (paper: 1 Hz)."""
    delay_ms: int = 300
    """PONDER's delay in ms (paper: fixed 300 ms)."""

    servers: Literal["in-process", "local"] = "in-process"
    """Place of each worker's servers: its own thread, or two processes that it starts."""
    workers: int = 1
    """Number of worker processes on this computer; each loads the checkpoints."""
    ray: str | None = None
    """Address of a Ray cluster to work on instead, or `auto`, or `local`. Logs then need an --out that nodes share."""
    gpus_per_worker: float = 0.0
    """GPUs that a worker requests with --ray; 0.5 puts two workers on each GPU."""
    record: bool = False
    """Write one MCAP per episode, about 10 MB a minute."""
    record_hz: Literal[1, 2, 4, 5, 10, 20] = 20
    """Rate of logged pictures in Hz, with --record; those that the models observe are logged as well."""
    patience_s: float = 600.0
    """Longest wait in seconds for servers to be ready, or for any answer."""
    progress: Annotated[bool, tyro.conf.FlagCreatePairsOff] = True
    """Do not show a progress bar."""

    def __post_init__(self) -> None:
        if min(self.episodes, self.runs, self.workers) < 1 or self.seed < 0:
            raise EvaluationError("--episodes, --runs and --workers must be at least 1, and --seed at least 0")
        if self.seed + self.episodes > TRAIN_SEED:
            raise EvaluationError(
                f"--seed {self.seed} with {self.episodes} episodes reaches into the training seeds, which begin at "
                f"{TRAIN_SEED}; evaluate on seeds below"
            )
        if self.reported_age_ms and self.deliver != "held-transition":
            raise EvaluationError("--reported-age-ms is for --deliver held-transition; otherwise ages are true")
        if self.cognition == "null" and self.deliver != "every":
            raise EvaluationError("--cognition null delivers nothing, so nothing is held; leave --deliver out")
        if (self.cognition == "other-episode") != (self.donors is not None):
            raise EvaluationError("--cognition other-episode and --donors go together: record the real one first")
        if self.cognition == "other-episode" and (self.servers, self.policy) != ("in-process", "servers"):
            raise EvaluationError("--cognition other-episode replaces PONDER: use --servers in-process")
        if self.subgoal_text is not None and (self.servers, self.cognition) != ("in-process", "real"):
            raise EvaluationError(
                "--subgoal-text is for --servers in-process, and POUNCE then reads no cognition: leave --cognition out"
            )

    def task_names(self) -> tuple[str, ...]:
        """The tasks in alphabetical order, each once. Raises TaskError for an unknown one."""
        return chosen_tasks(self.tasks)

    def jobs(self) -> list[Job]:
        """Returns every episode, task by task: a worker keeps its scene, and finished tasks are complete.

        Raises:
            TaskError: an unknown task.
            DonorError: an episode has no donor.
        """
        keys = [
            (task, run, seed)
            for task in self.task_names()
            for run in range(self.runs)
            for seed in range(self.seed, self.seed + self.episodes)
        ]
        donors = {} if self.donors is None else donors_in(self.donors, keys)
        return [
            Job(options=self, task=task, run=run, seed=seed, donor=donors.get((task, run, seed)))
            for task, run, seed in keys
        ]

    def sim(self) -> SimOptions:
        """Returns the episodes' options, as of `sim-client`."""
        return SimOptions(
            task="evaluation",
            episodes=self.episodes,
            seed=self.seed,
            difficulty=self.difficulty,
            policy=self.policy,
            out=self.out,
            local=self.servers == "local",
            in_process=self.servers == "in-process",
            ponder_checkpoint=self.ponder_checkpoint,
            pounce_checkpoint=self.pounce_checkpoint,
            patience_s=self.patience_s,
            query_period_ms=self.query_period_ms,
            delay_ms=self.delay_ms,
            deliver="null" if self.cognition == "null" else self.deliver,
            held_age_ms=self.reported_age_ms,
            max_steps=self.max_steps,
            demo_hz=self.demo_hz,
            video_end=self.video_end,
            record=self.record,
            record_hz=self.record_hz,
            progress=False,
        )

    def config(self) -> dict[str, Any]:
        """Returns the ``config`` of ``results.json``: sim-client's options, and those of the evaluation."""
        sim = self.sim()
        config: dict[str, Any] = as_json(dataclasses.asdict(sim))
        del config["task"], config["list_tasks"], config["demo_hz"], config["video_end"]
        if sim.showing.hz != 1:
            config["demo_hz"] = sim.showing.hz
        if sim.showing.to_its_end:
            config["video_end"] = True
        own = {"tasks": self.task_names(), "runs": self.runs, "cognition": self.cognition, "donors": self.donors}
        if self.subgoal_text is not None:
            own["subgoal_text"] = self.subgoal_text
        return config | {name: as_json(value) for name, value in own.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One episode to play."""

    options: EvalOptions
    task: str
    run: int
    seed: int
    donor: Path | None = None

    @property
    def key(self) -> str:
        return f"{self.task}/{self.run}/{self.seed}"


def main(argv: list[str] | None = None) -> int:
    set_up_logging("WARNING")
    try:
        options = tyro.cli(EvalOptions, args=argv, prog="pp-eval", description=EvalOptions.__doc__)
        episodes = evaluate(options, _workers(options))["episodes"]
    except (EvaluationError, LedgerError, DonorError, DatasetError, TaskError, TransportError) as error:
        sys.stderr.write(f"pp-eval: {error}\n")
        return REFUSED
    except KeyboardInterrupt:
        sys.stderr.write("pp-eval: interrupted; finished episodes are kept, the same command resumes\n")
        return INTERRUPTED
    for task in sorted({episode["task"] for episode in episodes}):
        successes = [episode["success"] for episode in episodes if episode["task"] == task]
        sys.stdout.write(f"{task}: {sum(successes)} of {len(successes)}\n")
    sys.stdout.write(f"{options.out / 'results.json'}; tables: pp-tables {options.out} --out {options.out}\n")
    return DONE


def evaluate(options: EvalOptions, workers: Workers[Job, Line]) -> dict[str, Any]:
    """Plays the missing episodes; returns the contents of ``results.json``, over everything in the folder.

    Whatever is raised, finished episodes are kept.

    Raises:
        EvaluationError: an episode could not be started.
        LedgerError: the folder holds another condition, or another process works in it.
        DatasetError: workers keep dying, or there is no Ray.
        TaskError, DonorError, TransportError: as their names say, before or at the first episode.
    """
    jobs = options.jobs()
    common = {name: value for name, value in options.config().items() if name not in (*_HOW_MANY, *_HOW)}
    with Ledger(options.out, common | {"versions": versions()}) as ledger:
        missing = [job for job in jobs if job.key not in ledger.lines]
        bar = tqdm(total=len(jobs), initial=len(jobs) - len(missing), unit="episode", disable=not options.progress)
        try:
            for job, line in workers.run(missing):
                ledger.commit(job.key, line)
                bar.update()
        finally:
            bar.close()
            results = {
                "config": options.config(),
                "versions": versions(),
                "episodes": _in_order(ledger.lines.values()),
            }
            write_json(options.out / "results.json", results)
    return results


def _in_order(lines: Iterable[Line]) -> list[Line]:
    return sorted(lines, key=lambda line: (line["task"], line["run"], line["seed"]))


def play(job: Job) -> Line:
    """Plays one episode in this process.

    Raises:
        EvaluationError: it did not start, because servers do not fit, refuse or died. That is no result of the policy;
            the same command tries again. Whatever ends an episode later is its result.
    """
    return _harness(job.options).play(job)


@cache
def _harness(options: EvalOptions) -> EvaluationHarness:
    """Returns this process's harness, with its servers loaded; it lasts as long as the process."""
    harness = EvaluationHarness(options)
    Finalize(None, harness.close, exitpriority=0)  # a worker's end, while GL and other threads are still there
    return harness


class EvaluationHarness:
    """One worker's servers, and the scene of its current task."""

    def __init__(self, options: EvalOptions) -> None:
        sim = options.sim()
        self._options = options
        self._donor: SwappedPonder | None = None
        self._open = contextlib.ExitStack()
        daemons = self._open.enter_context(Daemons(options.out / "servers" / str(os.getpid())))
        harness = open_harness(sim, daemons, self._replacement(), options.subgoal_text)
        self._open.callback(harness.bus.close)
        self._suite = Suite(sim, harness.link, harness.clock, daemons.dead)
        self._task = ""
        self._environment: Environment | None = None

    def play(self, job: Job) -> Line:
        """Like the function of this name."""
        if self._donor is not None and job.donor is not None:
            self._donor.load(job.donor)
        line = self._suite.play(self._scene(job.task), job.task, job.seed, run=job.run)
        if self._options.policy == "servers" and line["status"] == "ABORTED" and line["steps"] == 0:
            raise EvaluationError(f"{job.key} was not begun: {line['reason']}")
        if job.donor is not None:
            line["donor"] = job.donor.name
        return line

    def close(self) -> None:
        """Stops and frees everything; once more does nothing."""
        with self._open:
            if self._environment is not None:
                self._environment.close()
                self._environment = None

    def _scene(self, task: str) -> Environment:
        if self._environment is None or task != self._task:
            if self._environment is not None:
                self._environment.close()
            needs_frames = self._options.policy == "servers" or self._options.record  # the oracle alone needs none
            self._environment = make_environment(
                task,
                max_steps=self._options.max_steps,
                render=needs_frames,
            )
            self._task = task
        return self._environment

    def _replacement(self) -> BuildServer | None:
        """Returns what replaces PONDER, or None if PONDER itself is queried."""
        options = self._options
        if options.cognition == "other-episode":
            return self._build_donor
        is_unheard = options.cognition == "null" and options.servers == "in-process" and not options.record
        if is_unheard and options.pounce_checkpoint is not None:
            with contextlib.suppress(ValueError):  # a public folder does not hold K and H: PONDER has to be loaded
                shape = cognition_shape(options.pounce_checkpoint)
                return lambda bus, robot, _: NullPonder(Link(bus, robot=robot, proc="ponder"), *shape).step
        return None

    def _build_donor(self, bus: Bus, robot: str, checkpoint: Path | None) -> ServerStep:
        self._donor = SwappedPonder(Link(bus, robot=robot, proc="ponder"))
        return self._donor.step


def _workers(options: EvalOptions) -> Workers[Job, Line]:
    if options.ray is not None:
        return RayWorkers(options.ray, play, num_gpus=options.gpus_per_worker)
    return LocalWorkers(options.workers, play)
