"""``pp-train``: trains both systems together on a collected dataset, and leaves folders that the servers load.

    OUT/checkpoint/     weights, optimiser and step, from which a killed run resumes
    OUT/log.jsonl       one line per step
    OUT/samples.jsonl   PONDER's predicted texts at intervals, beside their targets
    OUT/ponder, pounce  at the end: checkpoints for ponder-serve and pounce-serve --checkpoint

The same command again resumes. On several GPUs or hosts:

    torchrun --nproc-per-node=8 -m dual_system.training.train --device cuda ...
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from tqdm import tqdm

from dual_system.models.bfloat16 import warn_of_slow
from dual_system.models.device import require_device
from dual_system.models.gpu import settle
from dual_system.models.pi05.pounce import PounceConfig
from dual_system.models.ponder.fused_attention import fuse_attention
from dual_system.models.ponder.recompute import recompute_layers
from dual_system.models.pounce.checkpoint import PounceBundle
from dual_system.models.pounce.family import sampling_of
from dual_system.training.build import Start, build, export
from dual_system.training.collate import collate_ponder, collate_pounce
from dual_system.training.data import PictureSizes, TrainingSet
from dual_system.training.ending import stop_requests
from dual_system.training.example import Example, make_example
from dual_system.training.frozen_towers import FrozenTowers
from dual_system.training.joint import JointModel, PonderBatch, PounceBatch
from dual_system.training.memory import memory_of, require_room, sentence
from dual_system.training.memory_words import words_to_remember
from dual_system.training.parallel import World, gather, joined, require_alike, shard
from dual_system.training.pointed_places import lessons_of, pointed_places, told_places
from dual_system.training.prefetch import Prefetcher
from dual_system.training.recipe import Recipe, defaults
from dual_system.training.recipes import recipe
from dual_system.training.trainer import CheckpointError, Trainer, num_steps_in
from dual_system.training.watch import Watch
from protocol import files
from protocol.command_line import On, command, parse

DONE, REFUSED, INTERRUPTED = 0, 2, 130
_SYSTEMS, CHECKPOINT = ("ponder", "pounce"), "checkpoint"
_EPISODE_STREAM, _LESSON_STREAM = 7, 8  # random streams of a step: for episodes and schedules, and for lessons


@dataclass(frozen=True, slots=True, kw_only=True)
class InsteadOptions:
    """Values that override the recipe's."""

    steps: int | None = None
    """Number of updates."""
    seed: int | None = None
    """Seed of batches, schedules and flow draws."""
    batch_episodes: int | None = None
    """Episodes per update, over all processes."""
    max_invocations: int | None = None
    """POUNCE invocations drawn from each episode of a batch."""
    max_committed_rows: int | None = None
    """Largest number of committed rows of a chunk in training, for `pounce-serve --continuity trained`; pi0.5 only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineOptions:
    """How the run uses the machine; results are the same up to rounding."""

    device: Literal["cpu", "cuda"] = "cpu"
    """Device of both systems."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Number format of both networks' matrices; norms stay float32, and the optimiser keeps float32 masters."""
    accumulate: int = 1
    """Parts of a batch that are computed one after the other: less memory, the same step up to rounding."""
    tf32: bool = False
    """Multiply float32 matrices in TF32 on a GPU that has it, which rounds to 1 in 2000."""
    weights: Literal["sharded", "whole"] = "sharded"
    """With several processes: each holds a shard of the weights (FSDP2), or all of them, which is faster for small
    models."""
    recompute: bool = False
    """Recompute PONDER's activations in the backward pass: less memory for long rows, more time."""
    length_groups: int = 1
    """Groups of like length into which the rows of a batch are divided: fewer padding tokens, more calls."""
    loaders: int = 0
    """Processes that prepare batches ahead; 0 prepares them in the training process."""
    cache_mb: int = 6000
    """Memory for decoded pictures [MB], at the sizes that the networks read."""
    frozen_features: bool = False
    """Store what frozen vision towers make of the pictures beside them in --picture-store, once, and train on that."""
    picture_store: Path | None = None
    """Folder for decoded pictures at those sizes: other processes and runs then need not decode videos."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LogOptions:
    """What a run writes while it trains."""

    save_every: int = 100
    """Updates between checkpoints."""
    sample_every: int = 20
    """Updates between samples of PONDER's texts (OUT/samples.jsonl)."""
    tensorboard: bool = False
    """Write losses, pictures and samples to OUT/tensorboard as well."""
    progress: On = True
    """Do not show a progress bar."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainOptions:
    """Trains PONDER and POUNCE together. The same command again resumes a run that was killed."""

    recipe: str
    """Name of a recipe: robomme and robocasa_dc are the paper's runs, robomme_* its ablations; tiny, tiny_groot,
    tiny_robocasa_dc, tiny_subgoal_text, tiny_framesamp and tiny_current are small ones for a CPU."""
    data: tuple[Path, ...]
    """Folders that pp-collect or pp-export made."""
    out: Path
    """Folder for checkpoints, log and the trained models."""
    ponder: Path | None = None
    """Pretrained Qwen3.5 folder; needed unless the recipe is from scratch."""
    pounce: Path | None = None
    """Pretrained pi0.5 or GR00T N1.5 folder; needed unless the recipe is from scratch."""
    tokenizer: Path | None = None
    """tokenizer.model (pi0.5) or tokenizer.json (GR00T), if the --pounce folder has none."""
    tasks: tuple[str, ...] = ()
    """Names of the tasks to train on. Empty: all of the data."""
    instead: tyro.conf.OmitArgPrefixes[InsteadOptions] = field(default_factory=InsteadOptions)
    machine: tyro.conf.OmitArgPrefixes[MachineOptions] = field(default_factory=MachineOptions)
    log: tyro.conf.OmitArgPrefixes[LogOptions] = field(default_factory=LogOptions)

    @property
    def start(self) -> Start:
        machine = self.machine
        return Start(
            ponder=self.ponder,
            pounce=self.pounce,
            tokenizer=self.tokenizer,
            device=machine.device,
            dtype=machine.dtype,
        )


class Batches:
    """Makes this process's share of a step's batch.

    Each schedule follows from (seed, step, place in the batch), so N processes together train on one process's batch.
    """

    def __init__(self, data: TrainingSet, run: Recipe, model: JointModel, bundle: PounceBundle, world: World) -> None:
        """Raises ValueError if the batch has fewer episodes than there are processes."""
        self._data, self._run = data, run
        self._bundle, self._device = bundle, world.device
        self._places = world.share(run.batch_episodes)
        # Not the model itself: worker processes copy this object (`prefetch`), and its weights may be on a GPU.
        self._form, self._pounce, self._runs_ponder = model.ponder.format, model.pounce.config, model.runs_ponder

    def __call__(self, step: int) -> tuple[PonderBatch, PounceBatch]:
        episodes, invocations = self.on_cpu(step)
        return episodes.to(self._device), invocations.to(self._device)

    def on_cpu(self, step: int) -> tuple[PonderBatch, PounceBatch]:
        """The batch of a step, not yet on the device."""
        run, bundle = self._run, self._bundle
        chance = (run.train.seed, _EPISODE_STREAM, step)
        numbers = self._draw(np.random.default_rng(chance))
        examples = [
            make_example(self._data[numbers[place]], self._form, run.example, np.random.default_rng([*chance, place]))
            for place in self._places
        ]
        episodes = collate_ponder(examples if self._runs_ponder else [])
        if run.trains == "ponder":
            examples = [_of_no_prompt(each) for each in examples]
        invocations = collate_pounce(examples, self._pounce, bundle.tokenizer, bundle.statistics)
        if run.grounds_memory and (sampling := sampling_of(self._pounce)) is not None:
            invocations = replace(invocations, words_IL=words_to_remember(examples, self._form, sampling))
        if run.grounds_pointer and isinstance(self._pounce, PounceConfig):
            lessons = self._lessons(step, examples, self._pounce)
            invocations = replace(invocations, places_IQ=pointed_places(examples, self._pounce), lessons=lessons)
        return episodes, invocations

    def _lessons(self, step: int, examples: Sequence[Example], config: PounceConfig) -> PounceBatch:
        chance = (self._run.train.seed, _LESSON_STREAM, step)
        made = [
            lessons_of(each, config, np.random.default_rng([*chance, place]))
            for each, place in zip(examples, self._places, strict=True)
        ]
        batch = collate_pounce(made, config, self._bundle.tokenizer, self._bundle.statistics)
        return replace(batch, places_IQ=told_places(made, config))

    def _draw(self, rng: np.random.Generator) -> list[int]:
        """Numbers of the batch's episodes, long ones first, so that the processes' shares have similar lengths."""
        numbers: list[int] = rng.integers(len(self._data), size=self._run.batch_episodes).tolist()
        return sorted(numbers, key=lambda number: -self._data.num_rows(number))


def _of_no_prompt(example: Example) -> Example:
    """One invocation without a prompt, for the batch's shape alone: where POUNCE is not run, no task is too long."""
    episode = replace(example.episode, instruction="")
    return replace(example, episode=episode, invocations=example.schedule.invocations[:1], told=("",))


@command("pp-train")
def main(argv: list[str] | None = None) -> int:
    options = parse(TrainOptions, argv, prog="pp-train")
    if warning := warn_of_slow(options.machine.dtype, options.machine.device):
        sys.stderr.write(f"pp-train: {warning}\n")
    try:
        train(options)
    except FloatingPointError as error:
        sys.stderr.write(f"pp-train: {error}\n")
        return REFUSED
    except torch.OutOfMemoryError as error:
        sys.stderr.write(f"pp-train: {_out_of_memory(options, error)}\n")
        return REFUSED
    except KeyboardInterrupt as stop:
        kept = str(stop) or "the last checkpoint is kept"
        sys.stderr.write(f"pp-train: interrupted; {kept}, the same command goes on from it\n")
        return INTERRUPTED
    return DONE


def train(options: TrainOptions) -> None:
    """Runs a recipe to its end, alone or as one of torchrun's processes.

    Raises:
        DatasetError, CheckpointError, FileNotFoundError, ValueError: the inputs do not fit; the message says why.
        FloatingPointError: the loss is not finite; the last checkpoint is kept.
        SaveError: a checkpoint could not be written; the previous one is kept.
    """
    machine, run = options.machine, _adjusted(recipe(options.recipe), options.instead)
    _require_unfinished(options.out, run)
    require_device(machine.device)
    if machine.tf32 and machine.device == "cpu":
        raise ValueError("--tf32 is for GPUs; on a CPU leave it out")
    data = TrainingSet(*options.data, tasks=options.tasks, demo_hz=run.demo_hz)
    data.require_trainable()
    with joined(machine.device) as world:
        share = run.batch_episodes // world.size  # every process has this many
        if min(machine.accumulate, machine.length_groups) < 1 or machine.accumulate * machine.length_groups > share:
            raise ValueError(
                f"--accumulate {machine.accumulate} parts of --length-groups {machine.length_groups}: expected at "
                f"least 1 of each, and together at most {share}, the episodes that every process has of a batch"
            )
        model, bundle = build(run, data, options.start)
        needed = memory_of(model, run.train.optim, world.size if machine.weights == "sharded" else 1)
        if world.is_first:
            sys.stderr.write(f"pp-train: {run.name} needs {sentence(needed, world.size)}\n")
        require_room(needed, world.size, torch.device(machine.device))
        if world.size > 1 and machine.weights == "sharded" and not model.ponder.format.remembers:
            raise ValueError(
                f"recipe {run.name}: a PONDER without memory decodes its own texts, which takes each process another "
                "number of passes, and sharded weights need the same of all; take --weights whole"
            )
        _prepare(model, machine, world)
        data = TrainingSet(
            *options.data,
            tasks=options.tasks,
            sizes=_picture_sizes(run, model),
            cache_mb=machine.cache_mb,
            store=machine.picture_store,
            demo_hz=run.demo_hz,
        )
        if machine.frozen_features:
            if world.is_first:
                sys.stderr.write(f"pp-train: frozen towers look at {len(data)} episodes, unless the store has them\n")
            data = data.embedded(FrozenTowers(model), world)
        with files.writing(options.out):
            _update(run, model, Batches(data, run, model, bundle, world), data.hash, options, world)
            _write(run, model, bundle, data, options, world)


def _update(
    run: Recipe, model: JointModel, batches: Batches, data_hash: str, options: TrainOptions, world: World
) -> None:
    """Runs all updates, from the checkpoint on if there is one; leaves the averaged weights in ``model``."""
    log, checkpoint = options.log, options.out / CHECKPOINT
    with ExitStack() as stack:
        prefetcher = None
        if options.machine.loaders:
            prefetcher = Prefetcher(batches.on_cpu, world.device, options.machine.loaders)
            stack.callback(prefetcher.close)
        made_with = asdict(run)
        del made_with["num_steps"]  # a run may go on for longer
        trainer = Trainer(
            model,
            prefetcher or batches,
            run.train,
            data_hash=data_hash,
            recipe=made_with,
            recipe_defaults=defaults(run),
            world=world,
            num_parts=options.machine.accumulate,
        )
        files.folder(options.out)
        trainer.resume(checkpoint)
        shows = log.progress and world.is_first
        bar = stack.enter_context(tqdm(total=run.num_steps, initial=trainer.step, unit="step", disable=not shows))
        watch = None
        if world.is_first:
            watch = Watch(
                options.out, first_step=trainer.step, sample_every=log.sample_every, tensorboard=log.tensorboard
            )
            stack.enter_context(watch)
        is_stop_requested = stack.enter_context(stop_requests())
        for report in trainer.run(run.num_steps):
            if watch is not None:
                watch.step(report, trainer)
            bar.set_postfix_str(f"flow {report.flow_matching:.3f} text {report.grounding:.3f}", refresh=False)
            bar.update()
            (num_requests,) = world.sums([is_stop_requested()])  # one that stops alone would leave the others waiting
            if num_requests or trainer.step % log.save_every == 0:
                if watch is not None:
                    watch.flush()
                trainer.save(checkpoint)
            if num_requests and trainer.step < run.num_steps:
                raise KeyboardInterrupt(f"step {trainer.step} of {run.num_steps} is saved")
        trainer.save(checkpoint)
        trainer.take_average()


def _require_unfinished(out: Path, run: Recipe) -> None:
    """Raises CheckpointError if ``out`` holds a finished run, unless its checkpoint has fewer steps than this one."""
    if not any((out / system).exists() for system in _SYSTEMS):
        return
    done = num_steps_in(out / CHECKPOINT)
    if done is None:
        raise CheckpointError(f"{out} holds a finished run without a {CHECKPOINT} to go on from; use another --out")
    if done >= run.num_steps:
        raise CheckpointError(
            f"{out} holds a finished run of {done} steps; --steps with a larger number goes on with it, or use "
            "another --out"
        )


def _prepare(model: JointModel, machine: MachineOptions, world: World) -> None:
    """Prepares a new model for the machine and the other processes."""
    require_alike(model, world)
    model.reads_together = machine.device != "cpu" or (world.size > 1 and machine.weights == "sharded")
    model.num_groups = machine.length_groups
    if machine.recompute:
        recompute_layers(model.ponder)
    if machine.device == "cuda" and machine.dtype == "float32":
        fuse_attention(model.ponder)
    settle(torch.device(machine.device), tf32=machine.tf32)
    if machine.weights == "sharded":
        shard(model, world)


def _write(
    run: Recipe, model: JointModel, bundle: PounceBundle, data: TrainingSet, options: TrainOptions, world: World
) -> None:
    """Writes the trained systems, from the first process alone."""
    if world.size == 1:
        export(model, bundle, options.out, trained=run.trains)
    else:
        whole = build(run, data, replace(options.start, device="cpu")) if world.is_first else None
        gather(model, None if whole is None else whole[0])
        if whole is not None:
            export(*whole, options.out, trained=run.trains)


def _adjusted(run: Recipe, instead: InsteadOptions) -> Recipe:
    """The recipe with the command line's overrides."""
    pounce = run.pounce
    if instead.max_committed_rows is not None:
        if not isinstance(pounce, PounceConfig):
            raise ValueError(f"--max-committed-rows is pi0.5's, recipe {run.name} trains GR00T")
        pounce = replace(pounce, max_committed_rows=instead.max_committed_rows)
    return replace(
        run,
        pounce=pounce,
        num_steps=instead.steps or run.num_steps,
        batch_episodes=instead.batch_episodes or run.batch_episodes,
        example=replace(run.example, max_invocations=instead.max_invocations or run.example.max_invocations),
        train=replace(run.train, seed=run.train.seed if instead.seed is None else instead.seed),
    )


def _picture_sizes(run: Recipe, model: JointModel) -> PictureSizes:
    """The picture sizes that the run's networks read."""
    pounce = model.pounce.config if run.trains != "ponder" else None
    return PictureSizes.of(model.ponder.format if model.runs_ponder else None, pounce)


def _out_of_memory(options: TrainOptions, error: BaseException) -> str:
    run = _adjusted(recipe(options.recipe), options.instead)
    tried = f"{run.batch_episodes} x {run.example.max_invocations}"
    return (
        f"out of memory at {tried} (episodes a step x invocations each; {error}). Raise --accumulate first; "
        "--recompute keeps less of PONDER's rows; --dtype bfloat16 halves the weights; or start more processes with "
        "torchrun. The last checkpoint is kept, and the same command with these goes on. --max-invocations and "
        "--batch-episodes make it another run, with another --out."
    )


if __name__ == "__main__":
    sys.exit(main())
