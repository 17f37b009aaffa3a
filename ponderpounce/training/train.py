"""``pp-train``: trains both systems together on a collected dataset, and leaves folders that the servers load.

    OUT/checkpoint/     where a killed run goes on: weights, optimiser, step
    OUT/log.jsonl       one line per step
    OUT/ponder, pounce  at the end: what ponder-serve and pounce-serve take as --checkpoint

The same command again resumes.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro
from tqdm import tqdm

from ponderpounce.data.errors import DatasetError
from ponderpounce.models.ponder import Ponder
from ponderpounce.models.ponder_checkpoint import load_ponder, save_ponder
from ponderpounce.models.pounce import Pounce, freeze
from ponderpounce.models.pounce_checkpoint import PounceBundle, load_bundle, random_bundle, save_bundle
from ponderpounce.models.prompt import Tokenizer
from ponderpounce.training.data import TrainingSet
from ponderpounce.training.example import collate, make_example
from ponderpounce.training.joint import JointModel, PonderBatch, PounceBatch
from ponderpounce.training.recipes import Recipe, recipe
from ponderpounce.training.trainer import CheckpointError, StepReport, Trainer

DONE, REFUSED, INTERRUPTED = 0, 2, 130
_EPISODE_STREAM = 7  # of a step's random numbers: which episodes, which schedules


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainOptions:
    """Trains PONDER and POUNCE together. The same command again resumes a run that was killed."""

    recipe: str
    """robomme and robocasa_dc are the paper's; tiny runs on one CPU core."""
    data: Path
    """A folder that pp-collect or pp-export made."""
    out: Path
    """Folder for checkpoints, log and the trained models."""
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
    save_every: int = 100
    """Steps between checkpoints."""
    device: Literal["cpu", "cuda"] = "cpu"
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Of PONDER's weights and of what POUNCE's stream runs in, when they are loaded."""
    progress: Annotated[bool, tyro.conf.FlagCreatePairsOff] = True


class Batches:
    """The batch of a step: which episodes, under which schedules; a function of (seed, step) alone."""

    def __init__(self, data: TrainingSet, run: Recipe, model: JointModel, bundle: PounceBundle, device: str) -> None:
        if not isinstance(bundle.tokenizer, Tokenizer):
            raise ValueError("training GR00T jointly is not built yet; use a recipe with pi0.5")
        self._data, self._run, self._model = data, run, model
        self._bundle, self._tokenizer, self._device = bundle, bundle.tokenizer, device

    def __call__(self, step: int) -> tuple[PonderBatch, PounceBatch]:
        rng = np.random.default_rng([self._run.train.seed, _EPISODE_STREAM, step])
        form, config = self._model.ponder.format, self._model.pounce.config
        numbers = rng.integers(len(self._data), size=self._run.batch_episodes)
        examples = [make_example(self._data[int(number)], form, self._run.example, rng) for number in numbers]
        episodes, invocations = collate(examples, config, self._tokenizer, self._bundle.statistics)
        return episodes.to(self._device), invocations.to(self._device)


def main(argv: list[str] | None = None) -> int:
    options = tyro.cli(TrainOptions, args=argv, prog="pp-train", description=TrainOptions.__doc__)
    try:
        train(options)
    except (DatasetError, CheckpointError, FileNotFoundError, ValueError, FloatingPointError) as error:
        sys.stderr.write(f"pp-train: {error}\n")
        return REFUSED
    except KeyboardInterrupt:
        sys.stderr.write("pp-train: interrupted; the last checkpoint is kept, the same command goes on from it\n")
        return INTERRUPTED
    return DONE


def train(options: TrainOptions) -> None:
    """Runs a recipe to its end.

    Raises:
        DatasetError, CheckpointError, FileNotFoundError, ValueError: what was given does not fit; the message says why.
        FloatingPointError: the loss is not finite; the last checkpoint is kept.
    """
    run = _adjusted(recipe(options.recipe), options)
    if (options.out / "pounce").exists():
        raise CheckpointError(f"{options.out} holds a finished run; use another --out")
    data = TrainingSet(options.data, tasks=options.tasks)
    model, bundle = build(run, data, options)
    trainer = Trainer(model, Batches(data, run, model, bundle, options.device), run.train, data_hash=data.hash)
    checkpoint = options.out / "checkpoint"
    options.out.mkdir(parents=True, exist_ok=True)
    trainer.resume(checkpoint)
    log_path = options.out / "log.jsonl"
    _cut_log(log_path, trainer.step)
    with (
        log_path.open("a") as log,
        tqdm(total=run.num_steps, initial=trainer.step, unit="step", disable=not options.progress) as bar,
    ):
        for report in trainer.run(run.num_steps):
            log.write(json.dumps(asdict(report)) + "\n")
            bar.set_postfix_str(_postfix(report), refresh=False)
            bar.update()
            if trainer.step % options.save_every == 0:
                log.flush()
                trainer.save(checkpoint)
    trainer.save(checkpoint)
    trainer.take_average()
    export(model, bundle, options.out)


def build(run: Recipe, data: TrainingSet, options: TrainOptions) -> tuple[JointModel, PounceBundle]:
    """Both systems, drawn or loaded, frozen as the recipe says, with the data's own statistics.

    Raises:
        ValueError: pretrained weights are missing, or the pictures have another size than PONDER reads.
        FileNotFoundError: a given folder holds no checkpoint.
    """
    dtype = {"float32": torch.float32, "bfloat16": torch.bfloat16}[options.dtype]
    seed = run.train.seed
    if not run.from_scratch and (options.ponder is None or options.pounce is None):
        raise ValueError(
            f"recipe {run.name} starts from pretrained weights; give their folders with --ponder, --pounce"
        )
    if options.ponder is not None:
        ponder = load_ponder(options.ponder, device=options.device, dtype=dtype)
    else:
        ponder = Ponder.random(run.ponder, seed=seed, device=options.device, dtype=dtype)
    if ponder.image_px != (data.image_px, data.image_px):
        raise ValueError(
            f"PONDER reads pictures of {ponder.image_px} px and {options.data} has {data.image_px} px; "
            f"collect with --image-px {ponder.image_px[0]}"
        )
    bundle = random_bundle(run.pounce, seed) if options.pounce is None else load_bundle(options.pounce)
    bundle = replace(bundle, statistics=data.statistics(run.pounce.horizon))
    pounce = bundle.model.to(options.device)
    if not isinstance(pounce, Pounce):
        raise ValueError("training GR00T jointly is not built yet; use a recipe with pi0.5")
    freeze(pounce, run.freeze)
    return JointModel(ponder, pounce, w1=run.w1, w2=run.w2), bundle


def export(model: JointModel, bundle: PounceBundle, out: Path) -> None:
    """Writes both folders as the servers read them."""
    model.ponder.is_random = False
    save_ponder(model.ponder, out / "ponder")
    save_bundle(replace(bundle, is_random=False, has_fresh_prefix=False), out / "pounce")


def _adjusted(run: Recipe, options: TrainOptions) -> Recipe:
    seed = run.train.seed if options.seed is None else options.seed
    return replace(run, num_steps=options.steps or run.num_steps, train=replace(run.train, seed=seed))


def _cut_log(path: Path, step: int) -> None:
    """Drops the lines of steps that a resumed run will do again."""
    if path.exists():
        lines = path.read_text().splitlines(keepends=True)
        path.write_text("".join(lines[:step]))


def _postfix(report: StepReport) -> str:
    return f"loss {report.total:.3f} flow {report.flow_matching:.3f} text {report.grounding:.3f}"


if __name__ == "__main__":
    sys.exit(main())
