"""``make policy``: trains the laptop pair from nothing, in slices of some minutes (`slices`).

    python -m benchmarks.policy --folder POLICY_DIR --minutes 150 [--tasks VideoUnmask PickHighlight]

At the end gates, losses, the table as far as it goes, and the account of hours are printed.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from benchmarks.policy_gates import gates
from benchmarks.policy_losses import losses
from benchmarks.policy_plan import TASKS, Task, stages, trained
from benchmarks.policy_table import table
from benchmarks.policy_weights import require_committed
from benchmarks.slices import account, run_stages
from protocol.command_line import command, parse


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicyOptions:
    """Trains the laptop pair; the same command goes on where the last slice ended (exit code 3: there is more)."""

    folder: Path
    """Where data, checkpoints and the account of hours are kept: tens of gigabytes, outside of the checkout."""
    minutes: float = 150.0
    """Length of this slice."""
    tasks: tuple[Task, ...] = TASKS
    """Tasks of data, plays and table, the same in every slice. Fewer take fewer hours and show less."""


@command("policy")
def main(argv: list[str] | None = None) -> int:
    options = parse(PolicyOptions, argv, prog="policy")
    folder = options.folder.resolve()
    planned = stages(folder, options.tasks)
    code = run_stages(planned, folder, options.minutes, lambda: require_committed(trained(folder), folder))
    sys.stdout.write(gates(folder / "gates") + losses(folder / "rows") + table(folder) + account(folder))
    return code


if __name__ == "__main__":
    sys.exit(main())
