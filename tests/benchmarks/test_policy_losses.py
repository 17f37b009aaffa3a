"""A run that still falls is marked, one that is not finished is not judged."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.policy_losses import losses


def write_run(folder: Path, flow: np.ndarray) -> None:
    (folder / "pounce").mkdir(parents=True)
    lines = (json.dumps({"step": step, "flow_matching": float(loss)}) for step, loss in enumerate(flow, 1))
    (folder / "log.jsonl").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(("last_loss", "is_marked"), [(1.0, False), (0.96, False), (0.94, True)])
def test_a_fall_of_more_than_a_twentieth_in_the_last_quarter_is_marked(
    tmp_path: Path, last_loss: float, is_marked: bool
) -> None:
    write_run(tmp_path / "row_0", np.concatenate([np.full(80, 1.0), np.full(20, last_loss)]))
    assert ("**unconverged**" in losses(tmp_path)) is is_marked


def test_losses_are_means_of_the_tenth_before(tmp_path: Path) -> None:
    write_run(tmp_path / "row_0", np.arange(200.0))
    cells = [cell.strip() for cell in losses(tmp_path).splitlines()[2].strip("|").split("|")]
    assert cells[:4] == ["row_0", "89.5000", "139.5000", "189.5000"]


def test_a_run_that_is_not_finished_is_left_out(tmp_path: Path) -> None:
    write_run(tmp_path / "row_0", np.ones(10))
    (tmp_path / "row_0" / "pounce").rmdir()
    assert losses(tmp_path) == ""
