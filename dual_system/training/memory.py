"""How much memory a run's weights, gradients and optimiser need in each process, before anything is allocated.

    python -m dual_system.training.memory robomme robomme_0p8b

Activations come on top; they depend on the rows' length, on --max-invocations, --accumulate and --recompute.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import tyro
from torch import nn

from dual_system.analysis.markdown import markdown
from dual_system.models.pi05.pounce import freeze
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.family import blank_model
from dual_system.models.pounce.precision import cast_streams
from dual_system.models.units import units_of
from dual_system.training.build import DTYPES, DTypeName
from dual_system.training.joint import JointModel
from dual_system.training.optim import OptimConfig
from dual_system.training.recipe import Recipe
from dual_system.training.recipes import recipe
from protocol.command_line import command, parse

GPUS = (1, 4, 8)
_FLOAT_BYTES = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """Bytes in one process."""

    weights: int
    gathered: int
    """Whole weights that FSDP2 keeps for the length of a step, and its largest unit."""
    gradients: int
    optimiser: int
    """float32 masters of narrower weights, AdamW's two averages, and the weights' own (EMA)."""

    @property
    def total(self) -> int:
        return self.weights + self.gathered + self.gradients + self.optimiser


def memory_of(model: nn.Module, optim: OptimConfig, num_shards: int = 1) -> Memory:
    """Memory of a model on any device, also meta, whose weights are divided among ``num_shards`` processes.

    Gradients are counted as the optimiser takes them, in float32.
    """
    weights = gradients = optimiser = 0
    is_averaged = optim.ema_decay > 0
    for each in model.parameters():
        count = -(-each.numel() // num_shards)
        weights += count * each.element_size()
        if each.requires_grad:
            gradients += count * _FLOAT_BYTES
            has_master = each.element_size() < _FLOAT_BYTES
            optimiser += count * _FLOAT_BYTES * (2 + has_master + is_averaged)
    return Memory(weights=weights, gathered=_gathered(model, num_shards), gradients=gradients, optimiser=optimiser)


def _gathered(model: nn.Module, num_shards: int) -> int:
    if num_shards == 1:
        return 0
    sizes = [sum(_num_bytes(each) for each in unit.parameters()) for unit in units_of(model)]
    return sum(map(_num_bytes, model.parameters())) - sum(sizes) + max(sizes, default=0)


def _num_bytes(parameter: nn.Parameter) -> int:
    return parameter.numel() * parameter.element_size()


def sentence(memory: Memory, num_processes: int) -> str:
    """One line for the person who starts a run."""
    gb = {name: f"{getattr(memory, name) / 1e9:.1f}" for name in ("total", "weights", "gradients", "optimiser")}
    return (
        f"{gb['total']} GB in each of {num_processes} processes: weights {gb['weights']}, gradients {gb['gradients']}, "
        f"optimiser {gb['optimiser']}; activations come on top"
    )


def require_room(memory: Memory, num_processes: int, device: torch.device) -> None:
    """Raises ValueError if a GPU is smaller than what is needed without activations."""
    if device.type != "cuda":
        return
    there = torch.cuda.get_device_properties(device).total_memory
    if memory.total > there:
        raise ValueError(
            f"the run needs {sentence(memory, num_processes)}. This GPU has {there / 1e9:.1f} GB: start more processes "
            "with torchrun, or take --dtype bfloat16"
        )


def blank(run: Recipe, dtype: DTypeName) -> JointModel:
    """A recipe's model at its published size, without memory."""
    ponder = Ponder.random(run.ponder, seed=0, device="meta", dtype=DTYPES[dtype])
    pounce = cast_streams(blank_model(run.pounce), dtype)
    freeze(pounce, run.freeze)
    return JointModel(ponder, pounce, trains=run.trains)


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryOptions:
    """Prints what a recipe's weights, gradients and optimiser need in each process."""

    recipes: tyro.conf.Positional[tuple[str, ...]]
    """Names of recipes."""
    dtype: DTypeName = "bfloat16"
    """Number format of both networks' matrices."""


@command("memory")
def main(argv: Sequence[str] | None = None) -> int:
    options = parse(MemoryOptions, argv, prog="python -m dual_system.training.memory")
    rows = []
    for name in options.recipes:
        run = recipe(name)
        model = blank(run, options.dtype)
        needs = [memory_of(model, run.train.optim, count).total / 1e9 for count in GPUS]
        rows.append([name, *(f"{gb:.1f}" for gb in needs)])
    sys.stdout.write(markdown(["recipe", *(f"GB, {count} process{'es' * (count > 1)}" for count in GPUS)], rows) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
