"""The benchmark of updates measures both and writes what it says."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import report, training_update


def test_ours_stands_beside_torchs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "REPORTS", tmp_path)
    assert training_update.main(["--recipe", "tiny", "--updates", "2"]) == 0
    written = json.loads((tmp_path / "training_update_cpu.json").read_text())
    (table,) = written["tables"]
    assert [row["update"] for row in table["rows"]] == ["ours, float32", "torch.optim.Muon, bfloat16"]
    assert all(row["n"] == 2 for row in table["rows"])
    assert "apart at most" in written["notes"][0]
