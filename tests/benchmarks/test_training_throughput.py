"""The training benchmark times each part, and counts what a step multiplies."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import report, training_throughput


@pytest.mark.peers
@pytest.mark.parametrize("recipe", ["tiny", "tiny_groot"])
def test_every_part_is_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recipe: str) -> None:
    monkeypatch.setattr(report, "REPORTS", tmp_path)
    few = ["--steps", "1", "--ticks", "5", "85", "--demo", "0", "--peak-size", "64"]
    assert training_throughput.main([*few, "--recipe", recipe]) == 0
    (table,) = json.loads((tmp_path / "training_throughput_cpu.json").read_text())["tables"]
    whole, together, apart, pounce = table["rows"]
    assert all(row["p50_ms"] > 0 and row["share_of_peak_%"] > 0 for row in table["rows"])
    assert whole["gflop"] == pytest.approx(apart["gflop"] + pounce["gflop"], rel=0.05, abs=0.02)
    assert apart["gflop"] < together["gflop"]  # no pads
