"""The training loop: reproducible steps, atomic checkpoints, and a resume that continues bit for bit.

Everything random in a step follows from (seed, step), so a checkpoint holds no random state: a step depends on the
weights, the optimiser and its number alone.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from torch import Tensor

from dual_system.models.pounce.family import max_committed_rows, sample_times
from dual_system.training.joint import Draws, JointModel, PonderBatch, PounceBatch
from dual_system.training.optim import OptimConfig, Optimiser
from dual_system.training.parallel import World, average_gradients, local
from dual_system.training.shards import RowReader, write_rows
from protocol import disk, files
from protocol.errors import CommandError

Batches = Callable[[int], tuple[PonderBatch, PounceBatch]]
"""This process's share of the batch of a step (``World.share``); a pure function of the step's number."""

_WEIGHTS, _OPTIMISER, _FACTS = "weights", "optimiser", "facts.json"
_DRAW_STREAM = 11  # random stream of a step for noise, flow times and cognition dropout


class CheckpointError(ValueError):
    """A run cannot continue from this checkpoint."""


class SaveError(CommandError):
    """A checkpoint could not be written; the previous one is intact."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StepReport:
    """Losses and counts of one update."""

    step: int
    total: float
    flow_matching: float
    grounding: float
    gradient_norm: float
    num_supervised: int
    num_null: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """Options of a step besides model and data."""

    seed: int = 42
    dropout: float = 0.0
    """Probability of cognition dropout (null cognition) per invocation (paper: RoboMME 0, RoboCasa-DC 0.15)."""
    flow_samples: int = 1
    """Draws of noise and flow time per invocation, which share one prefix. Above 1 for pi0.5 only."""
    optim: OptimConfig = field(default_factory=OptimConfig)


class Trainer:
    """Updates a joint model, one batch at a time; one of several processes takes its share of each batch."""

    def __init__(
        self,
        model: JointModel,
        batches: Batches,
        config: TrainConfig,
        *,
        data_hash: str = "",
        recipe: Mapping[str, Any] | None = None,
        recipe_defaults: Mapping[str, Any] | None = None,
        world: World | None = None,
        num_parts: int = 1,
    ) -> None:
        """``num_parts``: the parts of a batch that are computed one after the other; their gradients add up.

        A checkpoint made with another ``config``, ``data_hash`` or ``recipe`` (what else fixes the run) is refused.
        What it does not name, because it is of before that existed, it was made with as in ``recipe_defaults``.

        With several processes, ``model`` must be sharded already, or equal on all of them.
        """
        self.model = model
        self.config = config
        self.step = 0
        self._batches = batches
        made_with = {"train": asdict(config), "data": data_hash, **(recipe or {})}
        self._made_with: dict[str, Any] = json.loads(json.dumps(made_with))  # as a checkpoint's facts come back
        self._unnamed: dict[str, Any] = json.loads(json.dumps(recipe_defaults or {}))
        self._world, self._num_parts = world or World(), num_parts
        self._optimiser = Optimiser(model, config.optim)
        self._latest: tuple[PonderBatch, Tensor] | None = None

    def run(self, until: int) -> Iterator[StepReport]:
        """Updates until ``step`` is ``until``; yields after each.

        Raises:
            FloatingPointError: the loss or its gradients are not finite; the weights are those of the previous step.
        """
        while self.step < until:
            yield self._update()

    def _update(self) -> StepReport:
        world, model = self._world, self.model
        episodes, invocations = self._batches(self.step)
        parts = list(self._parts(episodes, invocations))
        # The losses are means over the whole batch: each part's mean is weighted by its share of the count.
        counts = [model.counts(*part) for part in parts]
        num_rows, num_supervised, num_null = (int(number) for number in world.sums(np.sum(counts, axis=0)))
        sums, predicted = np.zeros(3), []
        for part, (rows_here, supervised_here, _) in zip(parts, counts, strict=True):
            loss = model(*part)
            matching = loss.flow_matching * (rows_here / max(1, num_rows))
            grounding = loss.grounding * (supervised_here / max(1, num_supervised))
            total = model.weigh(matching, grounding)
            sums += world.sums([each.detach() for each in (total, matching, grounding)])
            if not np.isfinite(sums[0]):
                raise FloatingPointError(
                    f"step {self.step}: the loss is {sums[0]} (flow matching {sums[1]}, grounding {sums[2]}). Look at "
                    "that batch's data, or lower learning_rate; the last checkpoint is untouched."
                )
            (total * world.size).backward()  # averaging gradients over processes divides by their number
            average_gradients(model, world)
            self._optimiser.collect()
            predicted.append(loss.predicted_N)
        norm = self._optimiser.update(self.step)
        report = StepReport(
            step=self.step,
            total=float(sums[0]),
            flow_matching=float(sums[1]),
            grounding=float(sums[2]),
            gradient_norm=norm,
            num_supervised=num_supervised,
            num_null=num_null,
        )
        self.step += 1
        self._latest = episodes, torch.cat(predicted)
        return report

    @property
    def latest(self) -> tuple[PonderBatch, Tensor]:
        """This process's episodes of the last update, and PONDER's predictions in them (``JointLoss.predicted_N``).

        Raises:
            RuntimeError: there was no update yet.
        """
        if self._latest is None:
            raise RuntimeError("no step was done yet; latest is of the last one")
        return self._latest

    def _parts(
        self, episodes: PonderBatch, invocations: PounceBatch
    ) -> Iterator[tuple[PonderBatch, PounceBatch, Draws]]:
        """Yields the parts of a batch that are computed one after the other, with their draws."""
        if self._num_parts == 1:
            yield episodes, invocations, self._draws(invocations)
            return
        num_episodes = max(episodes.num_episodes, invocations.num_episodes)
        for numbers in np.array_split(np.arange(num_episodes), self._num_parts):
            begin, end = int(numbers[0]), int(numbers[-1]) + 1
            part = invocations.part(begin, end)
            yield episodes.part(begin, end), part, self._draws(part, begin)

    def _draws(self, invocations: PounceBatch, first: int = 0) -> Draws:
        """The random draws of this step, per episode: independent of the process and the part that has the episode."""
        generators = []
        for index in range(first, first + invocations.num_episodes):
            place = self._world.rank + index * self._world.size
            sequence = np.random.SeedSequence([self.config.seed, _DRAW_STREAM, self.step, place])
            generators.append(torch.Generator().manual_seed(int(sequence.generate_state(1, np.uint64)[0] >> 1)))
        return Draws.draw(
            invocations,
            partial(sample_times, self.model.pounce),
            self.config.dropout,
            generators,
            num_samples=self.config.flow_samples,
            max_committed_rows=max_committed_rows(self.model.pounce.config),
        )

    def take_average(self) -> None:
        """Replaces the weights by their average, at the end of a run; does nothing without an average."""
        self._optimiser.take_average()

    def save(self, folder: Path) -> None:
        """Writes a checkpoint atomically: a kill at any instant leaves the old one or the new one intact.

        Every process writes its own rows (``shards``), so all of them must see ``folder``.

        Raises:
            SaveError: a process could not write (a full disk); the old checkpoint is kept, the partial one removed.
        """
        fresh = folder.with_name(folder.name + ".tmp")
        world = self._world
        if world.is_first:
            shutil.rmtree(fresh, ignore_errors=True)
            fresh.mkdir(parents=True)
        world.wait()
        failure: Exception | None = None
        try:
            write_rows(_weights(self.model), fresh, _WEIGHTS, world)
            write_rows(self._optimiser.tensors(), fresh, _OPTIMISER, world)
            if world.is_first:
                facts = {"step": self.step, "made_with": self._made_with}
                (fresh / _FACTS).write_text(json.dumps(facts, indent=1) + "\n")
                disk.sync(fresh / _FACTS)
        except (OSError, SafetensorError) as error:
            failure = error
        (num_failed,) = world.sums([failure is not None])
        if world.is_first and num_failed:
            shutil.rmtree(fresh, ignore_errors=True)
        if num_failed:
            raise SaveError(_why_not_saved(folder, self.step, failure)) from failure
        if world.is_first:
            disk.exchange(fresh, folder)
        world.wait()

    def resume(self, folder: Path) -> bool:
        """Continues from a checkpoint of any number of processes; returns False if there is none yet.

        Raises:
            CheckpointError: it was made with another configuration, other data, or another model.
        """
        old = folder.with_name(folder.name + ".old")
        if self._world.is_first and not folder.exists() and old.exists():  # killed between the two renames
            old.rename(folder)
        self._world.wait()
        if not folder.exists():
            return False
        step, made_with = _facts_in(folder)
        then, now = (each.get("name") for each in (made_with, self._made_with))
        if then != now:
            raise CheckpointError(f"{folder}: made with recipe {then}, this run is of recipe {now}. Use another --out.")
        if differs := list(_differences(made_with, self._made_with, self._unnamed)):
            raise CheckpointError(
                f"{folder}: made with {'; '.join(differs[:5])}. Use another folder, or the same data and recipe."
            )
        mine = _weights(self.model)
        with RowReader(folder, _WEIGHTS, self._world) as stored, torch.no_grad():
            shapes = {name: stored.shape(name) for name in stored.names()}
            wanted = {name: tuple(tensor.shape) for name, tensor in mine.items()}
            if shapes != wanted:
                differs = sorted(name for name, _ in shapes.items() ^ wanted.items())
                raise CheckpointError(f"{folder}: of another model; differs in {differs[:5]}")
            for name, tensor in mine.items():
                local(tensor).copy_(stored.read(name, tensor))
        with RowReader(folder, _OPTIMISER, self._world) as stored:
            self._optimiser.load(stored)
        self.step = step
        return True


def num_steps_in(folder: Path) -> int | None:
    """Number of steps of a checkpoint; None if there is none. Raises FileError if it is broken."""
    return _facts_in(folder)[0] if folder.exists() else None


def _facts_in(folder: Path) -> tuple[int, dict[str, Any]]:
    facts = files.read_json(folder / _FACTS, "file of a checkpoint's facts")
    with files.reading(folder / _FACTS, "file of a checkpoint's facts"):
        return int(facts["step"]), dict(facts.get("made_with", {}))


def _weights(model: JointModel) -> dict[str, Tensor]:
    """Every parameter once, tied ones under their first name."""
    return {name: parameter.detach() for name, parameter in model.named_parameters()}


def _differences(then: Any, now: Any, unnamed: Any, name: str = "") -> Iterator[str]:
    """Dotted names of the values that differ, with both values; ``unnamed`` has those that ``then`` may lack."""
    if isinstance(then, dict) and isinstance(now, dict):
        usual = unnamed if isinstance(unnamed, dict) else {}
        for key in sorted(then.keys() | now.keys()):
            was = then.get(key, usual.get(key))
            yield from _differences(was, now.get(key), usual.get(key), f"{name}.{key}".lstrip("."))
    elif then != now:
        yield f"{name} {then}, this run has {now}"


def _why_not_saved(folder: Path, step: int, failure: Exception | None) -> str:
    free_gb = shutil.disk_usage(folder.parent).free / 1e9
    return (
        f"step {step}: {folder} could not be written ({failure or 'another process says why'}); "
        f"{free_gb:.1f} GB are free there. The one before is kept: make room, and the same command goes on from it."
    )
