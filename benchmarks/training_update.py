"""Duration of a Muon update of a small PONDER's matrices, ours beside torch's own.

Both update a copy of the same weights with the same gradients, in turns, each first every other time.
`dual_system.training.muon` explains their differences; the notes give the largest difference of the final weights.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from dual_system.training.muon import Muon
from torch import Tensor, nn

from benchmarks.report import Report, Row, show, spread
from dual_system.models.ponder.network import Ponder
from dual_system.training.optim import is_turned
from dual_system.training.recipe import stages_of
from dual_system.training.recipes import recipe
from protocol.command_line import parse

_RATE = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class UpdateOptions:
    """Random weights and random gradients, whose values do not affect the time."""

    recipe: str = "small_beginnings"
    threads: int = 1
    updates: int = 60
    """Measured updates of each, after an uncounted one."""


def main(argv: list[str] | None = None) -> int:
    options = parse(UpdateOptions, argv, prog="training-update")
    torch.set_num_threads(options.threads)
    report = Report(
        name="training_update_cpu",
        question="How long does Muon take to turn a small PONDER's matrices?",
        config=options,
        warm_up="one update of each.",
    )
    *_, run = stages_of(recipe(options.recipe))
    named = Ponder.random(run.ponder, seed=0).named_parameters()
    drawn = [each.detach().float() for name, each in named if is_turned(name, each)]
    ours, theirs = ([nn.Parameter(each.clone()) for each in drawn] for _ in range(2))
    optimisers: list[tuple[str, list[nn.Parameter], torch.optim.Optimizer]] = [
        ("ours, float32", ours, Muon(ours, lr=_RATE)),
        ("torch.optim.Muon, bfloat16", theirs, torch.optim.Muon(theirs, lr=_RATE, adjust_lr_fn="match_rms_adamw")),
    ]
    generator = torch.Generator().manual_seed(0)
    took_ms: dict[str, list[float]] = {name: [] for name, _, _ in optimisers}
    for count in range(options.updates + 1):
        gradients = [torch.randn(each.shape, generator=generator) for each in drawn]
        for name, parameters, optimiser in optimisers if count % 2 else reversed(optimisers):
            for parameter, gradient in zip(parameters, gradients, strict=True):
                parameter.grad = gradient.clone()
            start_ns = time.perf_counter_ns()
            optimiser.step()
            took_ms[name].append((time.perf_counter_ns() - start_ns) / 1e6)
    rows: list[Row] = []
    for name, took in took_ms.items():
        rows.append({"update": name} | spread(took[1:], "ms"))
    report.add_table(f"Of {len(drawn)} matrices, {sum(each.numel() for each in drawn)} numbers", rows)
    report.notes.append(
        f"After {options.updates + 1} updates the weights are {_apart(ours, theirs):.2g} apart at most, and "
        f"{_apart(ours, drawn):.2g} from where they were."
    )
    show(report)
    print(f"\nwritten: {report.write().name}")
    return 0


def _apart(left: Sequence[Tensor], right: Sequence[Tensor]) -> float:
    pairs = zip(left, right, strict=True)
    return max(float((one.detach() - other.detach()).abs().max()) for one, other in pairs)


if __name__ == "__main__":
    sys.exit(main())
