"""Whether a row of the table was trained long enough: its flow loss at half, three quarters and all of its steps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from dual_system.analysis.markdown import markdown
from dual_system.training.watch import LOG_FILE

_SHARES = (0.5, 0.75, 1.0)
_WINDOW = 0.1
"""Share of the steps, before each of them, over which losses are averaged."""
_STILL_FALLS = 0.05


def losses(runs: Path) -> str:
    """Returns a row for each finished run in a folder of runs; "" without one.

    A loss is the mean over rows that weigh branch points more (`ExampleConfig.branch_weight`). A run whose loss fell by
    more than a twentieth in its last quarter is marked: with more steps it would have become better.
    """
    rows = []
    for log in sorted(runs.glob(f"*/{LOG_FILE}")):
        if not (log.parent / "pounce").is_dir():
            continue  # not finished
        flow = np.array([json.loads(line)["flow_matching"] for line in log.read_text().splitlines()])
        width = max(1, round(_WINDOW * len(flow)))
        found = [float(flow[: round(share * len(flow))][-width:].mean()) for share in _SHARES]
        falls = found[-1] < (1 - _STILL_FALLS) * found[-2]
        rows.append([log.parent.name, *(f"{loss:.4f}" for loss in found), "**unconverged**" if falls else ""])
    shares = (f"loss at {100 * share:.0f} %" for share in _SHARES)
    return markdown(["run", *shares, ""], rows) + "\n" if rows else ""
