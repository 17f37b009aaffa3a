"""Collect, train, evaluate, diagnose, tables: one command after the other, each on what the one before it left."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from dual_system import commands
from dual_system.analysis import tables
from dual_system.training import train
from sim_client import evaluate

pytestmark = [pytest.mark.e2e, pytest.mark.sim, pytest.mark.slow]


def test_from_nothing_to_tables(tmp_path: Path, evaluate_here: Callable[[Sequence[str]], int]) -> None:
    data, run, out = (str(tmp_path / name) for name in ("data", "run", "tables"))
    pair = ("--ponder-checkpoint", f"{run}/ponder", "--pounce-checkpoint", f"{run}/pounce")
    few = ("--tasks", "PickHighlight", "--episodes", "1", "--runs", "1", "--max-steps", "21", "--no-progress")
    collected = ("--tasks", "PickHighlight", "--episodes", "2", "--frames", "training", "--invocation-hz", "1")
    assert commands.collect([*collected, "--workers", "1", "--out", data, "--no-progress"]) == 0
    trained = ("--recipe", "tiny", "--steps", "2", "--batch-episodes", "1", "--max-invocations", "2")
    assert train.main([*trained, "--data", data, "--out", run, "--no-progress"]) == 0
    for name, play in (("real", evaluate_here), ("null", evaluate.main)):
        assert play([*pair, *few, "--cognition", name, "--out", str(tmp_path / name)]) == 0
    diagnosed = ("--ponder", f"{run}/ponder", "--pounce", f"{run}/pounce", "--draws", "1")
    assert commands.diagnose([*diagnosed, "--data", data, "--out", f"{run}/diagnosis", "--no-progress"]) == 0
    folders = [str(tmp_path / "real"), str(tmp_path / "null"), f"{run}/diagnosis"]
    assert tables.main([*folders, "--out", out]) == 0

    lines = [json.loads((tmp_path / name / "results.json").read_text())["episodes"][0] for name in ("real", "null")]
    assert [line["steps"] for line in lines] == [21, 21]
    assert not any(model["is_untrained"] for line in lines for model in line["models"].values())
    assert lines[0]["stream_sha256"] != lines[1]["stream_sha256"]
    text = (tmp_path / "tables" / "tables.md").read_text()
    assert all(f"| {folder} |" in text for folder in folders)
    assert "exactly, if the button is pressed first: 33.33 over the scenes" in text
    assert (tmp_path / "tables" / "staleness.png").exists()
