"""Either network through ``torch.compile``: prefix and flow step separately, since one prefix serves many steps.

Mode "compile" is PyTorch's ``reduce-overhead``, with CUDA graphs on a GPU; "max-autotune" also searches for kernels.
Compiling takes a minute at the first invocation, which is the warm-up's; a prompt of another length may compile again.
"""

# B requests, N horizon, A padded action dim

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

import torch
from torch import Tensor

from dual_system.models import flow
from dual_system.models.flow import EulerStep
from dual_system.models.groot import flow as groot_flow
from dual_system.models.pi05.pounce import Pounce
from dual_system.models.pounce.family import AnyPounce

MODES: Final = {"compile": "reduce-overhead", "max-autotune": "max-autotune"}


def compiled_sampler(model: AnyPounce, mode: str) -> Callable[[Any, Tensor], Iterator[EulerStep]]:
    """Returns a function from inputs and noise (B, N, A) that samples like `Pounce.sample` or `GrootPounce.sample`.

    Args:
        mode: a key of `MODES`.
    """
    network: Any = model.pi05 if isinstance(model, Pounce) else model.groot
    euler = flow.euler if isinstance(model, Pounce) else groot_flow.euler
    table: Any = model.step_table()
    prefill: Any = torch.compile(model.prefill, mode=MODES[mode])
    velocity: Any = torch.compile(network.velocity, mode=MODES[mode])

    def sample(inputs: Any, noise_BNA: Tensor) -> Iterator[EulerStep]:
        torch.compiler.cudagraph_mark_step_begin()
        cache = prefill(inputs)

        def velocity_at(index: int, x_BNA: Tensor) -> Tensor:
            moved: Tensor = velocity(x_BNA, table.styles[index], cache)
            return moved.clone()  # the next step overwrites the graph's buffer

        return euler(velocity_at, noise_BNA.clone(), table.num_steps)

    return sample
