"""One condition to evaluate: the options of ``pp-eval``, and the episodes that they describe."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import tyro

from dual_system.tasks.difficulty import Difficulty
from dual_system.tasks.seeds import scenes, split_of
from protocol.command_line import On, flat
from protocol.errors import CommandError
from protocol.options import LinkOptions
from sim_client import config
from sim_client.config import ModelsOptions, ScheduleOptions, ServersOptions, SimOptions
from sim_client.swapped_ponder import donors_in
from sim_client.worlds import Pictures, chosen, limit, require


class EvaluationError(CommandError):
    """An evaluation that cannot run; the message says what was expected, what was given, and the way out."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConditionOptions:
    """The condition that is evaluated; the paper's by default."""

    cognition: Literal["real", "null", "other-episode"] = "real"
    """Cognition that POUNCE is conditioned on. real: PONDER's; null: the learned null; other-episode: PONDER's in
    another episode of the task."""
    donors: Path | None = None
    """Folder (--out) of a recorded evaluation of the same scenes with real cognition, for --cognition other-episode."""
    subgoal_text: Literal["ponder", "grounded", "simple", "displaced"] = "ponder"
    """Source of the subgoals for a POUNCE that reads text: PONDER, or the task, with places (grounded), without
    (simple), or with places that are 12 px off (displaced). The task's come as late as PONDER's."""
    pictures: Pictures = "own"
    """What the models are shown: the scene; another one, in which the arm moves alike; the scene without what only
    memory could tell later (PickHighlight's discs, the cubes of the unmasking tasks, a kitchen's demonstration); or
    retold: after another past (a goal set's twin), by which the episode is judged. pp-tables sets it beside the same
    scenes after their own. last-frame: a kitchen's demonstration, its last frame alone."""
    deliver: Literal["every", "held-transition"] = "every"
    """Delivery of cognition. held-transition: only the first, then those at predicted transitions (paper, 5.2)."""
    reported_age_ms: int = 0
    """Age in ms that POUNCE is told, whatever the true one; 0 is the true age. The paper fixes that of held transitions
    at 300."""
    query_period_ms: int = 1000
    """Period of PONDER's queries in ms (paper: 1 Hz). 0: one query an episode, whose cognition is never too old."""
    delay_ms: int = 300
    """PONDER's delay in ms (paper: fixed 300 ms)."""
    max_steps: int = 1300
    """Limit of control steps per episode (paper: 1300; a kitchen's end after 1000)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkersOptions:
    """Processes that play the episodes. The results do not depend on them."""

    workers: int = 1
    """Number of worker processes on this computer; each loads the checkpoints."""
    servers: Literal["in-process", "local", "running"] = "in-process"
    """Place of each worker's servers: its own thread, two processes that it starts, or servers that run already, at
    --link.connect, for one worker."""
    ray: str | None = None
    """Address of a Ray cluster to work on instead, or `auto`, or `local`. Logs then need an --out that nodes share."""
    gpus_per_worker: float = 0.0
    """GPUs of a worker with --device cuda: 0.5 puts two workers on each GPU. 0: all workers share the first one."""
    patience_s: float = 600.0
    """Longest wait in seconds for servers to be ready, or for any answer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LogOptions:
    """Logs and progress."""

    record: bool = False
    """Write one MCAP per episode, about 10 MB a minute."""
    record_hz: Literal[1, 2, 4, 5, 10, 20] = 20
    """Rate of logged pictures in Hz, with --record; those that the models observe are logged as well."""
    progress: On = True
    """Do not show a progress bar."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvalOptions:
    """Evaluates a pair of checkpoints as the paper does. The same command again resumes a killed evaluation."""

    out: Path
    """Folder of one condition: results.json, and with --record one MCAP per episode."""
    tasks: tuple[str, ...] = ("all",)
    """Names of the tasks, or `all` (RoboMME's sixteen). sim-client --list-tasks shows them."""
    ponder_checkpoint: Path | None = None
    """PONDER's checkpoint. None: random weights."""
    pounce_checkpoint: Path | None = None
    """POUNCE's checkpoint. None: random weights."""
    episodes: int = 50
    """Number of scenes per task (paper: 50)."""
    runs: int = 3
    """Number of times that every scene is played, each with other flow noise (paper: 3)."""
    split: Literal["demo", "development", "test", "rollouts"] | None = None
    """Split of the scenes (docs/evaluation.md). None: that of --seed; test scenes are played only if named."""
    seed: int | None = None
    """Seed of the first scene. None: the first of the split, without one 0."""
    difficulty: Difficulty | None = None
    """Difficulty of every scene. None: by seed, as the benchmark does."""
    policy: Literal["servers", "oracle"] = "servers"
    """Source of actions: the servers, or the tasks' own scripts (oracle), to test the machine."""
    condition: tyro.conf.OmitArgPrefixes[ConditionOptions] = field(default_factory=ConditionOptions)
    workers: tyro.conf.OmitArgPrefixes[WorkersOptions] = field(default_factory=WorkersOptions)
    models: tyro.conf.OmitArgPrefixes[ModelsOptions] = field(default_factory=ModelsOptions)
    link: LinkOptions = field(default_factory=lambda: SimOptions().link)
    log: tyro.conf.OmitArgPrefixes[LogOptions] = field(default_factory=LogOptions)

    def __post_init__(self) -> None:
        condition, workers, servers = self.condition, self.workers, self.workers.servers
        if min(self.episodes, self.runs, workers.workers) < 1:
            raise EvaluationError("--episodes, --runs and --workers must be at least 1")
        _ = self.seeds
        if condition.reported_age_ms and condition.cognition == "null":
            raise EvaluationError("--reported-age-ms is the age of a cognition, and --cognition null delivers none")
        if condition.cognition == "null" and condition.deliver != "every":
            raise EvaluationError("--cognition null delivers nothing, so nothing is held; leave --deliver out")
        if (condition.cognition == "other-episode") != (condition.donors is not None):
            raise EvaluationError("--cognition other-episode and --donors go together: record the real one first")
        if condition.cognition == "other-episode" and (servers, self.policy) != ("in-process", "servers"):
            raise EvaluationError("--cognition other-episode replaces PONDER: use --servers in-process")
        if condition.subgoal_text != "ponder" and (servers, condition.cognition) != ("in-process", "real"):
            raise EvaluationError(
                "--subgoal-text replaces PONDER: use --servers in-process, and leave --cognition out, as it gives none"
            )
        on_gpu = self.models.device == "cuda"
        if workers.gpus_per_worker and not on_gpu:
            raise EvaluationError("--gpus-per-worker divides the GPUs among workers: use it with --device cuda")
        if workers.ray is not None and on_gpu and not workers.gpus_per_worker:
            raise EvaluationError("--ray hides GPUs from workers that request none: add --gpus-per-worker")
        if servers == "running" and (
            workers.workers > 1
            or workers.ray is not None
            or self.models != ModelsOptions()
            or (self.ponder_checkpoint, self.pounce_checkpoint) != (None, None)
        ):
            raise EvaluationError(
                "--servers running asks servers that have their own checkpoints, devices and paths, with one worker: "
                "leave --workers, --ray, the checkpoints, --device, --dtype and --path out"
            )

    @property
    def seeds(self) -> range:
        """The scenes' seeds. Raises SeedError if they are not of one split, or of one that is not evaluated on."""
        return scenes(self.episodes, split=self.split, seed=self.seed)

    def task_names(self) -> tuple[str, ...]:
        """The tasks in alphabetical order, each once. Raises TaskError for an unknown one."""
        return chosen(self.tasks)

    def jobs(self) -> list[Job]:
        """Returns every episode, task by task: a worker keeps its scene, and finished tasks are complete.

        Raises:
            TaskError: an unknown task, or one without the pictures that are asked for.
            DonorError: an episode has no donor.
        """
        for task in self.task_names():
            require(task, self.condition.pictures)
        keys = [(task, run, seed) for task in self.task_names() for run in range(self.runs) for seed in self.seeds]
        folder = self.condition.donors
        donors = {} if folder is None else donors_in(folder, keys)
        return [
            Job(options=self, task=task, run=run, seed=seed, donor=donors.get((task, run, seed)))
            for task, run, seed in keys
        ]

    def sim(self, worker: int = 0) -> SimOptions:
        """Returns the episodes' options, as of `sim-client`, in the ``worker``-th process of this computer."""
        condition, models = self.condition, self.models
        max_steps = min((limit(task, condition.max_steps) for task in self.task_names()), default=condition.max_steps)
        if models.device == "cuda" and self.workers.ray is None:  # Ray shows a worker its own GPUs alone
            models = replace(models, device=f"cuda:{int(worker * self.workers.gpus_per_worker)}")
        return SimOptions(
            task="evaluation",
            episodes=self.episodes,
            seed=self.seeds[0],
            difficulty=self.difficulty,
            policy=self.policy,
            out=self.out,
            local=self.workers.servers == "local",
            in_process=self.workers.servers == "in-process",
            ponder_checkpoint=self.ponder_checkpoint,
            pounce_checkpoint=self.pounce_checkpoint,
            schedule=ScheduleOptions(
                query_period_ms=condition.query_period_ms,
                delay_ms=condition.delay_ms,
                deliver="null" if condition.cognition == "null" else condition.deliver,
                held_age_ms=condition.reported_age_ms,
                max_steps=max_steps,
            ),
            servers=ServersOptions(patience_s=self.workers.patience_s),
            models=models,
            link=self.link,
            log=config.LogOptions(record=self.log.record, record_hz=self.log.record_hz, progress=False),
        )

    def config(self) -> dict[str, Any]:
        """Returns the ``config`` of ``results.json``: sim-client's options, and those of the evaluation."""
        known = flat(self.sim())
        del known["task"], known["list_tasks"]
        known |= {"tasks": list(self.task_names()), "runs": self.runs, "cognition": self.condition.cognition}
        known["split"] = split_of(self.seeds[0])
        known["donors"] = None if self.condition.donors is None else str(self.condition.donors)
        usual = ConditionOptions()
        known |= {
            name: getattr(self.condition, name)
            for name in ("subgoal_text", "pictures")
            if getattr(self.condition, name) != getattr(usual, name)
        }
        return known


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
