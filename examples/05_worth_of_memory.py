"""Compares two folders of pp-eval scene by scene: with PONDER's cognition, and with the learned null.

python examples/05_worth_of_memory.py REAL NULL
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from dual_system.analysis.results import ResultsError, read_comparable


def main(folders: list[Path]) -> None:
    real, null = read_comparable(folders)
    if real.scenes != null.scenes:
        raise ResultsError(f"{real.label} and {null.label} were played in other scenes")
    pairs_N2 = np.concatenate([np.stack([real.outcomes[t], null.outcomes[t]], -1).reshape(-1, 2) for t in real.tasks])
    with_memory, without = pairs_N2.sum(axis=0)
    wins, losses = (pairs_N2[:, 0] > pairs_N2[:, 1]).sum(), (pairs_N2[:, 0] < pairs_N2[:, 1]).sum()
    print(f"with memory     {with_memory} of {len(pairs_N2)} episodes solved")
    print(f"without memory  {without} of {len(pairs_N2)}, in the same scenes")
    print(f"scene by scene  {wins} only with memory, {losses} only without")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main([Path(argument) for argument in sys.argv[1:]])
