"""The loop: steps that repeat exactly, checkpoints that survive a kill, and a resume that continues bit for bit.

Everything random in a step follows from (seed, step), so a checkpoint holds no random state: what a step does depends
on the weights, the optimiser and its number alone.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from ponderpounce.training.joint import Draws, JointModel, PonderBatch, PounceBatch
from ponderpounce.training.optim import OptimConfig, Optimiser

Batches = Callable[[int], tuple[PonderBatch, PounceBatch]]
"""The batch of a step; a pure function of its number."""

_WEIGHTS, _OPTIMISER, _FACTS = "weights.safetensors", "optimiser.safetensors", "facts.json"


class CheckpointError(ValueError):
    """A checkpoint cannot be continued from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StepReport:
    """What one update did."""

    step: int
    total: float
    flow_matching: float
    grounding: float
    gradient_norm: float
    num_supervised: int
    num_null: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """What a step depends on besides model and data."""

    seed: int = 42
    dropout: float = 0.0
    """Share of invocations that see the null cognition instead (paper: 0 for RoboMME, 0.15 for RoboCasa-DC)."""
    optim: OptimConfig = field(default_factory=OptimConfig)


class Trainer:
    """Updates a joint model, one batch at a time."""

    def __init__(self, model: JointModel, batches: Batches, config: TrainConfig, *, data_hash: str = "") -> None:
        """``data_hash`` names the data: a checkpoint made with other data is refused."""
        self.model = model
        self.config = config
        self.step = 0
        self._batches = batches
        self._data_hash = data_hash
        self._optimiser = Optimiser(model, config.optim)

    def run(self, until: int) -> Iterator[StepReport]:
        """Updates until ``step`` is ``until``; yields after each.

        Raises:
            FloatingPointError: the loss or its gradients are not finite; the weights are those of the step before.
        """
        while self.step < until:
            yield self._update()

    def _update(self) -> StepReport:
        episodes, invocations = self._batches(self.step)
        device = invocations.actions_INA.device
        generator = torch.Generator(device).manual_seed(_step_seed(self.config.seed, self.step))
        loss = self.model(episodes, invocations, Draws.draw(invocations.actions_INA, self.config.dropout, generator))
        if not torch.isfinite(loss.total):
            raise FloatingPointError(
                f"step {self.step}: the loss is {loss.total.item()} (flow matching {loss.flow_matching.item()}, "
                f"grounding {loss.grounding.item()}). Look at that batch's data, or lower learning_rate."
            )
        loss.total.backward()
        norm = self._optimiser.update(self.step)
        report = StepReport(
            step=self.step,
            total=loss.total.item(),
            flow_matching=loss.flow_matching.item(),
            grounding=loss.grounding.item(),
            gradient_norm=norm,
            num_supervised=loss.num_supervised,
            num_null=loss.num_null,
        )
        self.step += 1
        return report

    def take_average(self) -> None:
        """Puts the averaged weights in place of the last ones, at the end of a run; nothing where none are kept."""
        self._optimiser.take_average()

    def save(self, folder: Path) -> None:
        """Writes a checkpoint; a kill at any instant leaves the old one or the new one, whole."""
        fresh = folder.with_name(folder.name + ".tmp")
        shutil.rmtree(fresh, ignore_errors=True)
        fresh.mkdir(parents=True)
        save_file(_weights(self.model), fresh / _WEIGHTS)
        save_file({k: v.contiguous() for k, v in self._optimiser.tensors().items()}, fresh / _OPTIMISER)
        facts = {"step": self.step, "config": asdict(self.config), "data_hash": self._data_hash}
        (fresh / _FACTS).write_text(json.dumps(facts, indent=1) + "\n")
        for path in fresh.iterdir():
            _sync(path)
        old = folder.with_name(folder.name + ".old")
        if folder.exists():
            shutil.rmtree(old, ignore_errors=True)
            folder.rename(old)
        fresh.rename(folder)
        _sync(folder.parent)
        shutil.rmtree(old, ignore_errors=True)

    def resume(self, folder: Path) -> bool:
        """Continues from a checkpoint; False if there is none yet.

        Raises:
            CheckpointError: it was made with another configuration, other data, or another model.
        """
        old = folder.with_name(folder.name + ".old")
        if not folder.exists() and old.exists():  # killed between the two renames
            old.rename(folder)
        if not folder.exists():
            return False
        facts = json.loads((folder / _FACTS).read_text())
        for name, now in (("config", json.loads(json.dumps(asdict(self.config)))), ("data_hash", self._data_hash)):
            if facts[name] != now:
                raise CheckpointError(
                    f"{folder}: made with {name} {facts[name]}, this run has {now}. Use another folder, or the same "
                    "data and recipe."
                )
        weights = load_file(folder / _WEIGHTS)
        mine = _weights(self.model)
        if set(weights) != set(mine):
            raise CheckpointError(f"{folder}: of another model; differs in {sorted(set(weights) ^ set(mine))[:5]}")
        with torch.no_grad():
            for name, tensor in mine.items():
                tensor.copy_(weights[name])
        self._optimiser.load(load_file(folder / _OPTIMISER))
        self.step = facts["step"]
        return True


def _weights(model: JointModel) -> dict[str, Tensor]:
    """Every parameter once, tied ones under their first name."""
    return {name: parameter.detach() for name, parameter in model.named_parameters()}


def _step_seed(seed: int, step: int) -> int:
    return (seed * 1_000_003 + step) % 2**63


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
