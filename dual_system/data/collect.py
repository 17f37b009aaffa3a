"""``pp-collect``: collects oracle episodes of any number of tasks as a training dataset.

A collection is a set of independent jobs. Finished episodes lie in ``OUT/.collecting`` until the last one is there;
then they are joined aside in the jobs' order and moved into place, ``meta`` last. The same command resumes a killed
run, and the result is byte for byte that of an undisturbed run.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, Protocol

import tyro
from tqdm import tqdm

from dual_system.data.dart import DART, NoiseKind
from dual_system.data.episode import PANDA, Package, Rejection, RobotColumns, unpack
from dual_system.data.errors import DatasetError
from dual_system.data.jobs import DIFFICULTY_CYCLE, RECOVERY_SHARE, Job, Look, jobs_of
from dual_system.data.lerobot_files import INFO_PATH
from dual_system.data.lerobot_v3 import COLLECTION_PATH, DatasetWriter
from dual_system.data.rollout import UNSOLVED, work_out
from dual_system.data.shove import SHOVES
from dual_system.data.store import Store
from dual_system.data.video import check_image_px
from dual_system.data.workers import JobT, LocalWorkers, RayWorkers, Workers
from dual_system.tasks.difficulty import Difficulty
from dual_system.tasks.seeds import FIRST_COLLECTION_SEED
from dual_system.tasks.task import chosen_tasks
from protocol import files
from protocol.command_line import On, command, parse
from protocol.version import DISTRIBUTION

SCALES = {"1x": 1, "9x": 9}
COLLECTING, JOINED = ".collecting", "joined"
_SETTINGS_KIND = "settings file of pp-collect"
DONE, INCOMPLETE, REFUSED, INTERRUPTED = 0, 1, 2, 130
ROWS_PER_EPISODE, BYTES_PER_ROW = 500, 4200  # before anything is measured: both cameras at 256 px and 20 Hz, all tasks
MEASURED_EPISODES = 5  # from this number on, the estimate is measured


@dataclass(frozen=True, slots=True, kw_only=True)
class PicturesOptions:
    """Rendering of pictures."""

    frames: Literal["all", "training"] = "all"
    """Pictures to render: all at 20 Hz, or only those that training reads (demonstrations, POUNCE's invocations)."""
    invocation_hz: Literal[1, 2, 4, 5, 10, 20] = 10
    """Rate of POUNCE's invocations in Hz, with --frames training (paper: every 100 ms in training)."""
    demonstration_hz: Literal[1, 2, 4, 5, 10, 20] = 1
    """Rate of demonstration pictures in Hz, with --frames training; the last frame is always rendered (paper: 1)."""
    image_px: int = 256
    """Side of the pictures in pixels, an even number (paper and benchmark: 256)."""

    @property
    def look(self) -> Look:
        if self.frames == "all":
            return Look()
        return Look(demonstration_hz=self.demonstration_hz, execution_hz=self.invocation_hz)


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodesOptions:
    """Contents of the episodes."""

    difficulties: tuple[Difficulty, ...] = DIFFICULTY_CYCLE
    """Difficulties of a task's episodes, taken in turn."""
    noise: NoiseKind = "none"
    """Noise on the executed joint targets. dart: perturb the oracle's path; `action` stays the oracle's, the label."""
    recovery_share: float = RECOVERY_SHARE
    """Share of episodes in [0, 1] with a failed grasp, too high or beside the object, before the right one."""
    texts: Literal["latched", "follow"] = "latched"
    """Coordinates in subgoals. latched: as first seen (upstream); follow: corrected when the object was pushed."""
    shove_share: float = 0.0
    """Share of episodes in [0, 1] in which objects are pushed aside while the hand approaches; needs --texts follow."""
    max_steps: int = 1300
    """Limit of control steps per episode; longer episodes are not kept."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineOptions:
    """How the run uses the machine; the dataset does not depend on it."""

    workers: int = os.cpu_count() or 1
    """Number of worker processes on this computer."""
    ray: str | None = None
    """Address of a Ray cluster to work on instead, or `auto`, or `local`."""
    keep_episodes: bool = False
    """Keep OUT/.collecting, so that more --episodes can be added to the same folder."""
    progress: On = True
    """Do not show a progress bar."""


class Collection(Protocol[JobT]):
    """What is collected: `CollectOptions`, or the kitchen's pairs."""

    @property
    def out(self) -> Path: ...
    @property
    def machine(self) -> MachineOptions: ...
    @property
    def image_px(self) -> int: ...
    @property
    def robot(self) -> RobotColumns: ...
    def task_names(self) -> tuple[str, ...]: ...
    def jobs(self) -> list[JobT]:
        """One per episode, in the dataset's order."""
        ...

    def settings(self) -> dict[str, Any]:
        """What all episodes of a dataset have in common; their number and the workers are no part of it."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class CollectOptions:
    """Collects oracle episodes that succeed into a LeRobot v3 dataset. The same command again resumes a killed run."""

    out: Path
    """Folder of the dataset."""
    tasks: tuple[str, ...] = ("all",)
    """Names of the tasks, or `all`. sim-client --list-tasks shows them."""
    episodes: int = 100
    """Number of episodes per task, before --scale."""
    scale: Literal["1x", "9x"] = "1x"
    """Multiple of --episodes to collect (paper: 100 episodes per task, or 900)."""
    first_episode: int = 0
    """Number of episodes of each task to skip: a second folder then holds other scenes and seeds than the first."""
    pictures: tyro.conf.OmitArgPrefixes[PicturesOptions] = field(default_factory=PicturesOptions)
    content: tyro.conf.OmitArgPrefixes[EpisodesOptions] = field(default_factory=EpisodesOptions)
    machine: tyro.conf.OmitArgPrefixes[MachineOptions] = field(default_factory=MachineOptions)

    def __post_init__(self) -> None:
        if self.episodes < 1 or self.machine.workers < 1:
            raise DatasetError("--episodes and --workers must be at least 1")
        if self.first_episode < 0:
            raise DatasetError(f"--first-episode {self.first_episode}: episodes count from 0")
        check_image_px(self.pictures.image_px)
        if not 0 <= self.content.recovery_share <= 1:
            raise DatasetError(f"--recovery-share {self.content.recovery_share} is not a share, in [0, 1]")
        if not 0 <= self.content.shove_share <= 1:
            raise DatasetError(f"--shove-share {self.content.shove_share} is not a share, in [0, 1]")
        if self.content.shove_share and self.content.texts != "follow":
            raise DatasetError("--shove-share would make latched coordinates wrong; give --texts follow with it")

    @property
    def image_px(self) -> int:
        return self.pictures.image_px

    @property
    def robot(self) -> RobotColumns:
        return PANDA

    def task_names(self) -> tuple[str, ...]:
        """The tasks in alphabetical order, each once. Raises TaskError for an unknown one."""
        return chosen_tasks(self.tasks)

    def jobs(self) -> list[Job]:
        """Returns one job per episode, in the dataset's order."""
        num_episodes = self.episodes * SCALES[self.scale]
        jobs = jobs_of(
            self.task_names(),
            num_episodes,
            image_px=self.pictures.image_px,
            max_steps=self.content.max_steps,
            look=self.pictures.look,
            noise=self.content.noise,
            recovery_share=self.content.recovery_share,
            difficulties=self.content.difficulties,
            texts_follow=self.content.texts == "follow",
            shove_share=self.content.shove_share,
            first_slot=self.first_episode,
        )
        return list(jobs)

    def settings(self) -> dict[str, Any]:
        """Returns what all episodes of a dataset have in common; their number and the workers are no part of it."""
        versions = {name: metadata.version(name) for name in (DISTRIBUTION, "mujoco", "numpy", "av", "pyarrow")}
        settings = {
            "first_seed": FIRST_COLLECTION_SEED,
            "image_px": self.pictures.image_px,
            "max_steps": self.content.max_steps,
            "look": asdict(self.pictures.look),
            "versions": versions,
        }
        if self.first_episode:
            settings["first_episode"] = self.first_episode
        if self.content.recovery_share != RECOVERY_SHARE:
            settings["recovery_share"] = self.content.recovery_share
        if self.content.difficulties != DIFFICULTY_CYCLE:
            settings["difficulties"] = list(self.content.difficulties)
        if self.content.texts != "latched":
            settings["texts"] = self.content.texts
        if self.content.shove_share:
            settings["shoves"] = SHOVES.settings(self.content.shove_share)
        return settings if self.content.noise == "none" else {**settings, "noise": DART.settings()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """The result of a collection."""

    num_episodes: int
    num_rejected: int
    unsolved: tuple[str, ...]  # keys of jobs without an episode
    num_rejected_noisy: int = 0  # of those rejected, how many failed under noise


@command("pp-collect")
def main(argv: list[str] | None = None) -> int:
    try:
        options = parse(CollectOptions, argv, prog="pp-collect")
        report = collect(options, workers_on(options.machine, work_out), say=print_line)
    except KeyboardInterrupt:
        sys.stderr.write("pp-collect: interrupted; finished episodes are kept, the same command goes on\n")
        return INTERRUPTED
    noisy = "" if options.content.noise == "none" else f", {report.num_rejected_noisy} of them under noise"
    print_line(f"{report.num_episodes} episodes in {options.out} ({report.num_rejected} seeds rejected{noisy})")
    for key in report.unsolved:
        sys.stderr.write(f"pp-collect: no episode for {key}: the oracle solved none of its seeds\n")
    return INCOMPLETE if report.unsolved else DONE


def print_line(text: str) -> None:
    sys.stdout.write(text + "\n")


def collect(
    options: Collection[JobT], workers: Workers[JobT, Package], say: Callable[[str], None] = lambda text: None
) -> Report:
    """Collects what is missing and joins everything into the dataset.

    Raises:
        DatasetError: the folder holds something else, the disk is too small, or workers keep dying.
        TaskError: an unknown task.
    """
    jobs, out = options.jobs(), options.out
    wanted = {"settings": options.settings(), "tasks": options.task_names(), "episodes": len(jobs)}
    if (found := _finished(out, wanted)) is not None:
        say(f"{out} is complete; nothing to do")
        if not options.machine.keep_episodes:
            shutil.rmtree(out / COLLECTING, ignore_errors=True)
        return found
    files.folder(out)
    with Store(out / COLLECTING) as store:
        _claim(out / COLLECTING / "settings.json", options.settings())
        sizes = {job.key: store.num_bytes(job.key) for job in _present(store, jobs)}
        say(_disk_sentence(options, jobs, sizes))
        with tqdm(total=len(jobs), initial=len(sizes), unit="episode", disable=not options.machine.progress) as bar:
            for job, package in workers.run([job for job in jobs if job.key not in sizes]):
                try:
                    store.commit(job.key, package)
                except OSError as error:
                    raise DatasetError(f"cannot write {job.key}: {error}; make room and start again") from error
                sizes[job.key] = store.num_bytes(job.key)
                bar.set_postfix_str(f"{sum(sizes.values()) / 1e6:.0f} MB", refresh=False)
                bar.update()
                _require_disk(options, jobs, sizes)
        with files.writing(out):
            report = _join(out, store, jobs, wanted, options.robot)
    if not options.machine.keep_episodes:
        shutil.rmtree(out / COLLECTING)
    return report


def disk_needed(num_missing: int, sizes: Sequence[int], image_px: int) -> int:
    """Returns how many bytes a collection still needs: the missing episodes, and everything again when it is joined.

    A missing episode is estimated by the mean of ``sizes``, those that are there, or by a constant before there are
    five.
    """
    if len(sizes) >= MEASURED_EPISODES:
        mean = sum(sizes) / len(sizes)
    else:
        scale = image_px / 256
        mean = ROWS_PER_EPISODE * BYTES_PER_ROW * max(scale, scale**2)  # small pictures compress less, texts not at all
    return round(2 * num_missing * mean + sum(sizes))


def _require_disk(options: Collection[JobT], jobs: Sequence[JobT], sizes: dict[str, int]) -> tuple[int, int]:
    """Returns the bytes needed and free. Raises DatasetError if they are too few."""
    needed = disk_needed(len(jobs) - len(sizes), list(sizes.values()), options.image_px)
    free = shutil.disk_usage(options.out).free
    if needed > free:
        raise DatasetError(
            f"the disk of {options.out} is too small: {needed / 1e9:.1f} GB are still needed and {free / 1e9:.1f} GB "
            f"are free; {len(sizes)} of {len(jobs)} episodes are there and kept. Make room and start the same command "
            "again, or collect fewer --episodes, with --frames training or a smaller --image-px"
        )
    return needed, free


def _disk_sentence(options: Collection[JobT], jobs: Sequence[JobT], sizes: dict[str, int]) -> str:
    needed, free = _require_disk(options, jobs, sizes)
    source = "as measured" if len(sizes) >= MEASURED_EPISODES else "estimated"
    return (
        f"{len(jobs) - len(sizes)} of {len(jobs)} episodes to collect; disk: about {needed / 1e9:.2f} GB needed at "
        f"most ({source}), {free / 1e9:.1f} GB free"
    )


def _present(store: Store, jobs: Sequence[JobT]) -> list[JobT]:
    there = set(store.keys())
    return [job for job in jobs if job.key in there]


def _claim(path: Path, settings: dict[str, Any]) -> None:
    """Records the settings that a folder was begun with. Raises DatasetError if they differ now."""
    if path.exists():
        _require_equal(files.read_json(path, _SETTINGS_KIND), settings, path)
        return
    partial = path.with_suffix(".partial")
    with files.writing(path):
        partial.write_text(json.dumps(settings, indent=1) + "\n")
        partial.rename(path)


def _require_equal(there: Any, wanted: dict[str, Any], path: Path) -> None:
    with files.reading(path, _SETTINGS_KIND):
        differing = [name for name in {**wanted, **there} if there.get(name) != wanted.get(name)]
    if differing:
        changes = "; ".join(f"{name} was {there.get(name)} and is {wanted.get(name)}" for name in differing)
        raise DatasetError(
            f"{path.parent.parent} was begun with other settings: {changes}. Use the same, or another --out"
        )


def _finished(out: Path, wanted: dict[str, Any]) -> Report | None:
    """Returns the report of a finished dataset; None if there is none yet, or if it is to be extended.

    Raises DatasetError if the folder holds another dataset that cannot be extended.
    """
    if not (out / INFO_PATH).exists():
        return None
    if not (out / COLLECTION_PATH).exists():
        raise DatasetError(f"{out} holds a dataset that pp-collect did not make; use another --out")
    path = out / COLLECTION_PATH
    there = files.read_json(path, _SETTINGS_KIND)
    with files.reading(path, _SETTINGS_KIND):
        _require_equal(there["settings"], wanted["settings"], path)
        if there["episodes"] == wanted["episodes"] and tuple(there["tasks"]) == wanted["tasks"]:
            return Report(
                num_episodes=there["episodes"] - len(there["unsolved"]),
                num_rejected=there["num_rejected"],
                unsolved=tuple(there["unsolved"]),
                num_rejected_noisy=there.get("num_rejected_noisy", 0),
            )
    if not (out / COLLECTING).exists():
        raise DatasetError(
            f"{out} is a finished dataset of {there['episodes']} episodes, and its single episodes were not kept "
            "(--keep-episodes); collect more into another --out"
        )
    return None


def _join(out: Path, store: Store, jobs: Sequence[JobT], wanted: dict[str, Any], robot: RobotColumns) -> Report:
    """Joins all episodes aside, in the jobs' order, and moves the dataset into place, ``meta`` last."""
    aside = out / COLLECTING / JOINED
    shutil.rmtree(aside, ignore_errors=True)
    writer = DatasetWriter(aside, robot)
    unsolved: list[str] = []
    rejected: list[Rejection] = []
    for job in jobs:
        package = store.read(job.key)
        if UNSOLVED in package:
            unsolved.append(job.key)
            rejected += [Rejection(**each) for each in json.loads(package[UNSOLVED])]
            continue
        episode = unpack(package)
        rejected += episode.about.rejected
        writer.add(episode)
    if len(unsolved) == len(jobs):
        raise DatasetError(f"the oracle solved no episode at all of {', '.join(wanted['tasks'])}")
    writer.finish()
    report = Report(
        num_episodes=len(jobs) - len(unsolved),
        num_rejected=len(rejected),
        unsolved=tuple(unsolved),
        num_rejected_noisy=sum(each.noise_rad > 0 for each in rejected),
    )
    summary = {**wanted, "num_rejected": report.num_rejected, "unsolved": unsolved}
    if "noise" in wanted["settings"]:
        summary["num_rejected_noisy"] = report.num_rejected_noisy
    (aside / COLLECTION_PATH).write_text(json.dumps(summary, indent=1) + "\n")
    for name in ("meta", "data", "videos"):  # without meta it is no dataset: a kill from here on ends in joining again
        shutil.rmtree(out / name, ignore_errors=True)
    for name in ("data", "videos", "meta"):
        (aside / name).rename(out / name)
    return report


def workers_on(machine: MachineOptions, work: Callable[[JobT], Package]) -> Workers[JobT, Package]:
    """The processes that do the work, on this computer or a Ray cluster."""
    return LocalWorkers(machine.workers, work) if machine.ray is None else RayWorkers(machine.ray, work)


if __name__ == "__main__":
    sys.exit(main())
