"""What a row of the laptop table costs: processor time of its models for a second of play, and bytes between them.

    python -m benchmarks.policy_cost --out cost.json --ponder words/ponder --pounce rows/laptop_0/pounce

The paper's schedule asks each model once a second: PONDER in a context that grows as an episode's does, POUNCE with all
that its channels hold. One thread; five uncounted calls of each.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dual_system.models.ponder.checkpoint import load_ponder
from ponder_server.contract import Opening
from ponder_server.engine import QwenEngine
from ponder_server.engine_config import EngineConfig
from pounce_server.__main__ import build_engine as build_pounce
from pounce_server.config import PounceOptions, SpeedOptions
from pounce_server.contract import example_request
from protocol import files
from protocol.command_line import command, parse

_WARM_UP = 5
_FLOAT_BYTES = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class CostOptions:
    """Measures one row's models."""

    out: Path
    """The JSON file to write."""
    pounce: Path
    """Checkpoint of POUNCE."""
    ponder: Path | None = None
    """Checkpoint of PONDER; None for a row without one."""
    count: int = 50
    """Calls of each that are counted: an episode of so many seconds."""


@command("policy-cost")
def main(argv: list[str] | None = None) -> int:
    options = parse(CostOptions, argv, prog="policy-cost")
    torch.set_num_threads(1)
    found = cost(options)
    with files.writing(files.folder(options.out.parent)):
        options.out.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found))
    return 0


def cost(options: CostOptions) -> dict[str, Any]:
    """Processor times [ms] of a call of each model, and the bytes of a cognition; a text's are not counted."""
    pounce = build_pounce(PounceOptions(checkpoint=options.pounce, speed=SpeedOptions(path="eager")))
    request = example_request(pounce.spec)
    found: dict[str, Any] = {
        "count": options.count,
        "pounce_cpu_ms": _cpu_ms(lambda: pounce.invoke(request), options.count),
        "cognition_bytes": _FLOAT_BYTES * pounce.spec.num_carriers * pounce.spec.cognition_size,
    }
    if options.ponder is not None:
        ponder = QwenEngine(load_ponder(options.ponder), EngineConfig(max_sessions=1))
        ponder.open("robot", Opening(instruction=request.instruction))
        frames = ponder.example_frames()
        found["ponder_cpu_ms"] = _cpu_ms(lambda: ponder.fire("robot", frames), options.count)
    return found


def _cpu_ms(call: Callable[[], object], count: int) -> dict[str, float]:
    took_ms = []
    for _ in range(_WARM_UP + count):
        began_s = time.process_time()
        call()
        took_ms.append(1e3 * (time.process_time() - began_s))
    quantiles = np.quantile(took_ms[_WARM_UP:], (0.5, 0.95, 0.99, 1.0))
    return dict(zip(("p50", "p95", "p99", "max"), (round(float(each), 2) for each in quantiles), strict=True))


if __name__ == "__main__":
    sys.exit(main())
