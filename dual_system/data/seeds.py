"""Division of the scenes' seeds between training and evaluation."""

from __future__ import annotations

TRAIN_SEED = 2_000_000
"""Training seeds begin here; those below are for evaluation."""
