"""``pp-train``: trains both systems together on a collected dataset, and leaves folders that the servers load.

    OUT/checkpoint/     where a killed run goes on: weights, optimiser, step
    OUT/log.jsonl       one line per step; OUT/run.png draws it at the end
    OUT/samples.jsonl   what PONDER says at intervals, beside what it should
    OUT/ponder, pounce  at the end: what ponder-serve and pounce-serve take as --checkpoint

A recipe of several stages leaves all of that in a folder for each, and the newest of either model in OUT as well.

The same command again resumes. On several GPUs or hosts:

    torchrun --nproc-per-node=8 -m dual_system.training.train --device cuda ...
"""

from __future__ import annotations

import shutil
import sys
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

from dual_system.data.episode import CAMERAS
from dual_system.data.errors import DatasetError
from dual_system.data.lerobot_v3 import ALBUM, INFO_PATH
from dual_system.models.bfloat16 import warn_of_slow
from dual_system.models.bfloat16_products import multiply_in_bfloat16
from dual_system.models.eyes import check_cameras, readable_sizes
from dual_system.models.normalisation import ROBOMME
from dual_system.models.pi05.pounce import PounceConfig, freeze
from dual_system.models.pi05.prompt import Tokenizer, tokenizer_of_instructions
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.fused_attention import fuse_attention
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.recompute import recompute_layers
from dual_system.models.ponder.vocabulary import Vocabulary
from dual_system.models.pounce.checkpoint import PounceBundle, load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.initialise import open_gates
from dual_system.training.ahead import Ahead
from dual_system.training.collate import collate_ponder, collate_pounce
from dual_system.training.data import Sight, TrainingSet
from dual_system.training.example import make_example
from dual_system.training.in_words import told_in_words
from dual_system.training.joint import JointModel, PonderBatch, PounceBatch, Trains
from dual_system.training.notes import can_follow
from dual_system.training.parallel import World, gather, joined, require_alike, shard
from dual_system.training.plot import plot_log
from dual_system.training.recipe import Curriculum, Recipe, stages_of
from dual_system.training.recipes import recipe
from dual_system.training.seeing import SeeOptions, see_things
from dual_system.training.trainer import CheckpointError, SaveError, StepReport, Trainer
from dual_system.training.watch import LOG_FILE, Watch

DONE, REFUSED, INTERRUPTED = 0, 2, 130
_SYSTEMS = ("ponder", "pounce")
_EPISODE_STREAM = 7  # of a step's random numbers: which episodes, which schedules


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainOptions:
    """Trains PONDER and POUNCE together. The same command again resumes a run that was killed."""

    recipe: str
    """robomme and robocasa_dc are the paper's; starter and small learn from scratch on CPU cores, those whose names
    begin with small_ go on from there; tiny and tiny_groot are for a try."""
    data: tuple[Path, ...]
    """Folders that pp-collect, pp-export or pp-correct made: episodes to imitate."""
    out: Path
    """Folder for checkpoints, log and the trained models."""
    watch: tuple[Path, ...] = ()
    """Further folders, of pp-export: what policies did, with the simulator's words. PONDER alone learns from them."""
    watch_share: float = 0.5
    """With --watch: how much of a batch is watched; one episode at least is not."""
    album: tuple[Path, ...] = ()
    """Folders of pp-album, for a recipe that opens PONDER's eyes first; () for those that lie in DATA/album."""
    stage: str | None = None
    """Of a recipe with stages, only this one: stages that do not need each other can run side by side."""
    tasks: tuple[str, ...] = ()
    """Train on these tasks of the data; () for all."""
    ponder: Path | None = None
    """Pretrained Qwen3.5 folder; needed unless the recipe is from scratch."""
    pounce: Path | None = None
    """Pretrained pi0.5 folder; needed unless the recipe is from scratch."""
    steps: int | None = None
    """Instead of the recipe's."""
    seed: int | None = None
    """Instead of the recipe's."""
    batch_episodes: int | None = None
    """Instead of the recipe's: episodes a step, of all processes together."""
    max_invocations: int | None = None
    """Instead of the recipe's: POUNCE's invocations an episode."""
    event_weight: float | None = None
    """Instead of the recipe's: how much likelier invocations are drawn that come just before a grasp, a release or a
    new subgoal."""
    max_committed_rows: int | None = None
    """Instead of the recipe's: pi0.5 learns to continue up to so many rows, for `pounce-serve --continuity trained`."""
    save_every: int = 100
    """Steps between checkpoints."""
    sample_every: int = 20
    """Steps between samples of what PONDER says (OUT/samples.jsonl)."""
    tensorboard: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also write OUT/tensorboard: losses, pictures and samples."""
    cache_mb: int = 6000
    """Memory for pictures, at the sizes that the networks read; what does not fit is decoded again."""
    sights: Path | None = None
    """Keep pictures there as well, at those sizes: further processes, stages and runs then need not decode videos.
    A recipe that opens eyes has OUT/sights."""
    weights: Literal["sharded", "whole"] = "sharded"
    """Of several processes each holds its rows (FSDP2), or all: faster where they fit many times over, as on CPUs."""
    recompute: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """PONDER's layers are run again on the way back instead of remembered: less memory for long rows, and more time."""
    device: Literal["cpu", "cuda"] = "cpu"
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Of PONDER's weights and of what POUNCE's stream runs in, when they are loaded."""
    products: Literal["float32", "tfloat32", "bfloat16"] = "float32"
    """bfloat16: of float32 weights' linear layers; takes CPUs that have it a third of the time, and rounds to 1 in 250;
    all else stays float32. tfloat32: of all float32 products on GPUs that have it, and rounds to 1 in 2000."""
    loaders: int = 0
    """Processes that make batches ahead, for a GPU that learns faster than one lays out rows; 0: none."""
    length_groups: int = 1
    """Rows that are read together are padded to the longest of their group of like length: fewer pads, more calls."""
    progress: Annotated[bool, tyro.conf.FlagCreatePairsOff] = True


class Batches:
    """This process's share of a step's batch: which episodes, under which schedules.

    Each schedule follows from (seed, step, place in the batch), so the shares of N processes are the batch of one.
    """

    def __init__(
        self,
        data: TrainingSet,
        run: Recipe,
        model: JointModel,
        bundle: PounceBundle,
        world: World,
        watch_share: float = 0.5,
    ) -> None:
        """Raises ValueError if the batch has fewer episodes than there are processes, or the share is none."""
        if not 0 <= watch_share <= 1:
            raise ValueError(f"--watch-share must be in [0, 1], came {watch_share}")
        self._data, self._run = data, run
        self._watch_share = watch_share
        self._bundle, self._device = bundle, world.device
        self._places = world.share(run.batch_episodes)
        # not the model itself: another process may ask (`ahead`), and its weights lie on a GPU
        size = model.ponder.hidden_size
        self._form, self._pounce = model.ponder.format, model.pounce.config
        self._stand_in_size = size if model.needs_stand_ins else 0
        self._place_size = size if model.w4 > 0 else 0

    def __call__(self, step: int) -> tuple[PonderBatch, PounceBatch]:
        episodes, invocations = self.on_cpu(step)
        return episodes.to(self._device), invocations.to(self._device)

    def on_cpu(self, step: int) -> tuple[PonderBatch, PounceBatch]:
        """The same, not yet on the device."""
        run, bundle = self._run, self._bundle
        chance = (run.train.seed, _EPISODE_STREAM, step)
        numbers = self._draw(np.random.default_rng(chance))
        examples = [
            make_example(
                self._data[int(numbers[place])],
                self._form,
                run.example,
                np.random.default_rng([*chance, place]),
            )
            for place in self._places
        ]
        episodes = collate_ponder(
            examples,
            with_rows=run.trains != "pounce",
            stand_in_size=self._stand_in_size,
            moved_weight=run.moved_weight,
            place_size=self._place_size,
        )
        if run.trains == "ponder":  # nobody acts: any moment will do, also one that is not to be imitated
            examples = [replace(each, invocations=each.schedule.invocations[:1], nudges_I2=None) for each in examples]
        return episodes, collate_pounce(examples, self._pounce, bundle.tokenizer, bundle.statistics)

    def _draw(self, rng: np.random.Generator) -> NDArray[np.integer]:
        """Numbers of the batch's episodes; the last of them are watched ones.

        Long ones come first among their kind, so that the processes' shares are as long as each other.
        """
        size, first = self._run.batch_episodes, self._data.num_imitated
        numbers = rng.integers(first, size=size)
        if first < len(self._data):
            num_watched = min(round(self._watch_share * size), size - 1)
            numbers[size - num_watched :] = rng.integers(first, len(self._data), size=num_watched)
        return np.array(sorted(numbers.tolist(), key=lambda number: (number >= first, -self._data.num_rows(number))))


def main(argv: list[str] | None = None) -> int:
    options = tyro.cli(TrainOptions, args=argv, prog="pp-train", description=TrainOptions.__doc__)
    for option, precision in (("--dtype", options.dtype), ("--products", options.products)):
        if warning := warn_of_slow(precision, options.device, option):
            sys.stderr.write(f"pp-train: {warning}\n")
    try:
        train(options)
    except (DatasetError, CheckpointError, SaveError, OSError, ValueError, FloatingPointError) as error:
        sys.stderr.write(f"pp-train: {error}\n")
        return REFUSED
    except torch.OutOfMemoryError as error:
        sys.stderr.write(f"pp-train: {_out_of_memory(options, error)}\n")
        return REFUSED
    except KeyboardInterrupt:
        sys.stderr.write("pp-train: interrupted; the last checkpoint is kept, the same command goes on from it\n")
        return INTERRUPTED
    return DONE


def train(options: TrainOptions) -> None:
    """Runs a recipe to its end, alone or as one of torchrun's processes.

    Raises:
        DatasetError, CheckpointError, FileNotFoundError, ValueError: what was given does not fit; the message says why.
        FloatingPointError: the loss is not finite; the last checkpoint is kept.
        SaveError: a checkpoint could not be written; the one before is kept.
    """
    chosen = recipe(options.recipe)
    if _is_finished(options.out):
        raise CheckpointError(f"{options.out} holds a finished run; use another --out")
    data = TrainingSet(*options.data, tasks=options.tasks)
    with joined(options.device) as world:
        if isinstance(chosen, Recipe):
            if options.stage is not None:
                raise ValueError(f"recipe {chosen.name} has no stages; leave --stage out")
            _train(_adjusted(chosen, options), data, options, world)
        else:
            _train_stages(chosen, data, options, world)


def _train_stages(curriculum: Curriculum, data: TrainingSet, options: TrainOptions, world: World) -> None:
    names = [stage.name.rpartition("/")[2] for stage in curriculum.stages]
    if options.stage is not None and options.stage not in names:
        raise ValueError(f"recipe {curriculum.name} has the stages {', '.join(names)}; there is no {options.stage!r}")
    latest = options if curriculum.eyes_steps == 0 else _with_open_eyes(curriculum, options, world)
    for name, stage in zip(names, curriculum.stages, strict=True):
        out = options.out / name
        is_wanted = options.stage in (None, name)
        if is_wanted and not _is_finished(out):
            if world.is_first:
                tqdm.write(f"stage {name}", file=sys.stderr)
            _train(_adjusted(stage, options), data, replace(latest, out=out), world)
        latest = replace(
            latest,
            ponder=out / "ponder" if (out / "ponder").exists() else latest.ponder,
            pounce=out / "pounce" if (out / "pounce").exists() else latest.pounce,
        )
    if world.is_first and _is_finished(options.out / names[-1]):
        for newest in (latest.ponder, latest.pounce):  # which a stage of the other system alone did not touch
            if newest is not None and newest.is_relative_to(options.out):
                shutil.copytree(newest, options.out / newest.name)


def _with_open_eyes(curriculum: Curriculum, options: TrainOptions, world: World) -> TrainOptions:
    """A new PONDER learns to see, into OUT/eyes, unless it did already or one is given; the stages go on from it."""
    options = replace(options, sights=options.sights or options.out / "sights")
    eyes = options.out / "eyes"
    if options.ponder is not None:
        return options
    albums = options.album or tuple(
        info.parent.parent for folder in options.data for info in sorted(folder.glob(f"{ALBUM}/*/{INFO_PATH}"))
    )
    if not albums:
        raise ValueError(
            f"recipe {curriculum.name} opens PONDER's eyes first and needs an album: collect with --album 6000, or "
            "give one of pp-album with --album; or a PONDER that can see with --ponder"
        )
    if world.is_first and not (eyes / "ponder").exists():
        tqdm.write("eyes", file=sys.stderr)
        num_threads = torch.get_num_threads()
        torch.set_num_threads(max(world.size, num_threads))  # the others wait
        see_things(
            SeeOptions(
                recipe=curriculum.name,
                data=options.data,
                album=albums,
                out=eyes,
                steps=curriculum.eyes_steps,
                seed=options.seed or 0,
                progress=options.progress,
            )
        )
        torch.set_num_threads(num_threads)
    world.wait()
    return replace(options, ponder=eyes / "ponder")


def _is_finished(out: Path) -> bool:
    return any((out / system).exists() for system in _SYSTEMS)


def _train(run: Recipe, data: TrainingSet, options: TrainOptions, world: World) -> None:
    if options.products == "tfloat32" and options.device == "cpu":
        raise ValueError("--products tfloat32 is for GPUs; on a CPU leave it out, or give bfloat16")
    if not 0 < options.length_groups <= max(1, run.batch_episodes // world.size):  # all processes have as many groups
        raise ValueError(
            f"--length-groups {options.length_groups}: expected 1 to {run.batch_episodes // world.size}, the rows that "
            "every process has of a batch"
        )
    model, bundle = build(run, data, options)
    require_alike(model, world)
    model.reads_together = options.device != "cpu" or (world.size > 1 and options.weights == "sharded")
    if options.recompute:
        recompute_layers(model.ponder)
    if options.products == "bfloat16":
        multiply_in_bfloat16(model)
    if options.device == "cuda" and options.dtype == "float32":
        fuse_attention(model.ponder)
    torch.backends.cuda.matmul.allow_tf32 = options.products == "tfloat32"
    model.num_groups = options.length_groups
    if options.weights == "sharded":
        shard(model, world)
    data = TrainingSet(
        *options.data,
        watched=options.watch if run.trains != "pounce" else (),
        tasks=options.tasks,
        sight=_sight(run, model),
        cache_mb=options.cache_mb,
        sights=options.sights,
        demo_hz=run.demo_hz,
    )
    batches = Batches(data, run, model, bundle, world, options.watch_share)
    ahead = Ahead(batches.on_cpu, world.device, options.loaders) if options.loaders else None
    trainer = Trainer(model, ahead or batches, run.train, data_hash=data.hash, world=world)
    checkpoint = options.out / "checkpoint"
    options.out.mkdir(parents=True, exist_ok=True)
    trainer.resume(checkpoint)
    progress = options.progress and world.is_first
    with ExitStack() as stack:
        if ahead is not None:
            stack.callback(ahead.close)
        bar = stack.enter_context(tqdm(total=run.num_steps, initial=trainer.step, unit="step", disable=not progress))
        watch = stack.enter_context(_watch(options, trainer.step)) if world.is_first else None
        for report in trainer.run(run.num_steps):
            if watch is not None:
                watch.step(report, trainer)
            bar.set_postfix_str(_postfix(report), refresh=False)
            bar.update()
            if trainer.step % options.save_every == 0:
                if watch is not None:
                    watch.flush()
                trainer.save(checkpoint)
    trainer.save(checkpoint)
    if world.is_first:
        plot_log(options.out / LOG_FILE, options.out / "run.png")
    trainer.take_average()
    if world.size == 1:
        export(model, bundle, options.out, trained=run.trains)
        return
    whole = build(run, data, replace(options, device="cpu")) if world.is_first else None
    gather(model, None if whole is None else whole[0])
    if whole is not None:
        export(*whole, options.out, trained=run.trains)
    world.wait()  # the next stage begins with what was written


def build(run: Recipe, data: TrainingSet, options: TrainOptions) -> tuple[JointModel, PounceBundle]:
    """Both systems, drawn or loaded, frozen as the recipe says, with the data's own statistics.

    Raises:
        ValueError: pretrained weights are missing, or the pictures have another size than PONDER reads.
        FileNotFoundError: a given folder holds no checkpoint.
    """
    if run.example.takes_notes and not can_follow():
        raise ValueError(f"recipe {run.name} takes notes of what moves, and draws scenes for it: pip install mujoco")
    dtype = {"float32": torch.float32, "bfloat16": torch.bfloat16}[options.dtype]
    seed = run.train.seed
    if not run.from_scratch and (options.ponder is None or options.pounce is None):
        raise ValueError(
            f"recipe {run.name} starts from pretrained weights; give their folders with --ponder, --pounce"
        )
    if options.ponder is not None:
        ponder = load_ponder(options.ponder, device=options.device, dtype=dtype)
    else:
        own = Vocabulary.trained_on(data.texts(), run.ponder.first_carrier_id) if run.has_own_tokenizers else None
        ponder = Ponder.random(run.ponder, own, seed=seed, device=options.device, dtype=dtype)
    try:
        check_cameras([(data.image_px, data.image_px)] * len(CAMERAS), ponder.format.eyes, ponder.image_px)
    except ValueError as error:
        wanted_px = readable_sizes(ponder.format.eyes, ponder.image_px)[0][0]
        raise ValueError(f"{', '.join(map(str, options.data))}: {error}; collect with --image-px {wanted_px}") from None
    if run.trains != "pounce":
        ponder.format = replace(
            ponder.format,
            speaks=run.w2 > 0,
            takes_notes=run.example.takes_notes,
            demonstrations=data.showing(run.demo_hz) or ponder.format.demonstrations,
        )
    measured = partial(data.statistics, run.pounce.horizon, run.space, by_row=run.statistics_by_row)
    if options.pounce is None:
        bundle = random_bundle(run.pounce, seed, statistics=measured(), tokenizer=_own_tokenizer(run, data))
        open_gates(bundle.model)
    else:
        bundle = load_bundle(options.pounce)
        if run.pounce.reads_subgoal and not bundle.model.config.reads_subgoal:
            bundle = told_in_words(bundle, run.pounce, _own_tokenizer(run, data), seed)
        if bundle.statistics == ROBOMME:  # a public folder; our own act in the measure that they were trained in
            bundle = replace(bundle, statistics=measured())
    pounce = bundle.model.to(options.device)
    if type(pounce.config) is not type(run.pounce):
        raise ValueError(f"recipe {run.name} is of another action model than {options.pounce} holds")
    if isinstance(pounce.config, PounceConfig) and isinstance(run.pounce, PounceConfig):
        pounce.config = replace(pounce.config, max_committed_rows=run.pounce.max_committed_rows)
    freeze(pounce, run.freeze)
    return JointModel(
        ponder,
        pounce,
        w1=run.w1,
        w2=run.w2,
        w3=run.w3,
        w4=run.w4,
        aligns_evenly=run.aligns_evenly,
        trains=run.trains,
        keeps_eyes=run.keeps_eyes,
        reads_apart=run.reads_apart,
        specialty=run.specialty,
        narrowing=run.narrowing,
    ), bundle


def _own_tokenizer(run: Recipe, data: TrainingSet) -> Tokenizer | None:
    """POUNCE's, of all that it will be told in the data; None: the family's."""
    if not run.has_own_tokenizers or not isinstance(run.pounce, PounceConfig):
        return None
    return tokenizer_of_instructions(data.told() if run.pounce.reads_subgoal else data.instructions())


def export(model: JointModel, bundle: PounceBundle, out: Path, *, trained: Trains = "both") -> None:
    """Writes the folders of what was trained, as the servers read them."""
    if trained != "pounce":
        model.ponder.is_random = False
        save_ponder(model.ponder, out / "ponder")
    if trained != "ponder":
        save_bundle(replace(bundle, is_random=False, has_fresh_prefix=False), out / "pounce")


def _adjusted(run: Recipe, options: TrainOptions) -> Recipe:
    """The recipe with what the command line says instead."""
    seed = run.train.seed if options.seed is None else options.seed
    pounce = run.pounce
    if options.max_committed_rows is not None:
        if not isinstance(pounce, PounceConfig):
            raise ValueError(f"--max-committed-rows is pi0.5's, recipe {run.name} trains GR00T")
        pounce = replace(pounce, max_committed_rows=options.max_committed_rows)
    return replace(
        run,
        pounce=pounce,
        num_steps=options.steps or run.num_steps,
        batch_episodes=options.batch_episodes or run.batch_episodes,
        example=replace(
            run.example,
            max_invocations=options.max_invocations or run.example.max_invocations,
            event_weight=run.example.event_weight if options.event_weight is None else options.event_weight,
        ),
        train=replace(run.train, seed=seed),
    )


def _sight(run: Recipe, model: JointModel) -> Sight:
    """What the run reads of the pictures."""
    pounce = model.pounce.config
    sees = run.trains != "ponder" and pounce.num_cameras > 0
    return Sight(
        form=model.ponder.format if run.trains != "pounce" else None, pounce_px=pounce.image_px if sees else None
    )


def _watch(options: TrainOptions, step: int) -> Watch:
    return Watch(options.out, first_step=step, sample_every=options.sample_every, tensorboard=options.tensorboard)


def _postfix(report: StepReport) -> str:
    parts = {"flow": report.flow_matching, "text": report.grounding, "align": report.alignment, "place": report.placing}
    return " ".join(f"{name} {value:.3f}" for name, value in parts.items() if value)


def _out_of_memory(options: TrainOptions, error: BaseException) -> str:
    sizes = [_adjusted(stage, options) for stage in stages_of(recipe(options.recipe))]
    tried = " or ".join(f"{size.batch_episodes} x {size.example.max_invocations}" for size in sizes)
    return (
        f"out of memory at {tried} (episodes a step x invocations each; {error}). Lower --max-invocations first, then "
        "--batch-episodes; --recompute keeps less of PONDER's rows; --dtype bfloat16 halves PONDER; or start more "
        "processes with torchrun. The last checkpoint is kept: the same command with the lower number goes on."
    )


if __name__ == "__main__":
    sys.exit(main())
