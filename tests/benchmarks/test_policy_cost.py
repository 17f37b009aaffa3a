"""What a row costs: two models are dearer than one, and a vector has the bytes of its numbers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.policy_cost import main
from dual_system.models.normalisation import ROBOMME
from dual_system.models.ponder.checkpoint import save_ponder
from dual_system.models.ponder.configs import tiny_cpu as tiny_ponder
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_cpu


def test_a_row_with_ponder_and_one_without(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ponder = Ponder.random(replace(tiny_ponder(), num_layers=4), seed=0)
    save_ponder(ponder, tmp_path / "ponder")
    sizes = {"pair": tiny_cpu(num_carriers=2, cognition_size=ponder.hidden_size), "alone": tiny_cpu(num_carriers=0)}
    found = {}
    for name, config in sizes.items():
        save_bundle(random_bundle(config, 0, statistics=ROBOMME), tmp_path / name)
        given = ("--ponder", f"{tmp_path / 'ponder'}") if name == "pair" else ()
        out = tmp_path / f"{name}.json"
        assert main(["--out", f"{out}", "--pounce", f"{tmp_path / name}", "--count", "2", *given]) == 0
        found[name] = json.loads(out.read_text())
        assert json.loads(capsys.readouterr().out) == found[name]
    assert found["pair"]["cognition_bytes"] == 4 * 2 * ponder.hidden_size
    assert found["alone"]["cognition_bytes"] == 0
    assert "ponder_cpu_ms" not in found["alone"]
    for times in (found["pair"]["ponder_cpu_ms"], found["pair"]["pounce_cpu_ms"], found["alone"]["pounce_cpu_ms"]):
        assert 0 < times["p50"] <= times["p95"] <= times["p99"] <= times["max"]
