"""A PONDER without memory from data to a checked log: collect, train, resume, export, play, check, diagnose."""

from __future__ import annotations

from pathlib import Path

import pytest

from clock import check
from dual_system import commands
from dual_system.training import train
from ponder_server.writer import TransitionWriter
from protocol.command_line import parse
from protocol.mcap_log import read_log
from sim_client.condition import EvalOptions
from sim_client.evaluate import EvaluationHarness

pytestmark = [pytest.mark.e2e, pytest.mark.sim, pytest.mark.slow, pytest.mark.acceptance]


def test_it_is_trained_resumed_served_and_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, run, played = (str(tmp_path / name) for name in ("data", "run", "played"))
    collected = ("--tasks", "VideoUnmask", "--episodes", "2", "--frames", "training", "--invocation-hz", "1")
    assert commands.collect([*collected, "--workers", "1", "--out", data, "--no-progress"]) == 0
    trained = ("--recipe", "tiny_current", "--batch-episodes", "1", "--max-invocations", "2")
    for steps in ("1", "2"):
        assert train.main([*trained, "--steps", steps, "--data", data, "--out", run, "--no-progress"]) == 0

    # After two steps its gate may never open, and its texts never end.
    monkeypatch.setattr(TransitionWriter, "gate", lambda *_: (True, 1.0))
    monkeypatch.setattr(TransitionWriter, "_limit", lambda *_: 6)
    pair = ("--ponder-checkpoint", f"{run}/ponder", "--pounce-checkpoint", f"{run}/pounce")
    few = ("--tasks", "VideoUnmask", "--episodes", "1", "--runs", "1", "--max-steps", "61", "--no-progress")
    options = parse(EvalOptions, [*pair, *few, "--record", "--record-hz", "1", "--out", played], prog="pp-eval")
    harness = EvaluationHarness(options)  # in this process, where the two above hold
    try:
        (line,) = [harness.play(job) for job in options.jobs()]
    finally:
        harness.close()
    assert line["steps"] == 61
    (log,) = Path(played).rglob("*.mcap")
    assert check.main([str(log)]) == 0
    record = read_log(log)
    assert record.info.has_demo
    assert len(record.cognitions) >= 3
    assert len({each.context_tokens for each in record.cognitions}) == 1  # nothing accumulates
    before = ""
    for each in record.cognitions:
        assert each.text
        assert each.text_source_ns == each.source_ns
        assert each.is_transition == (each.text != before)
        before = each.text

    diagnosed = ("--ponder", f"{run}/ponder", "--pounce", f"{run}/pounce", "--draws", "1", "--data", data)
    assert commands.diagnose([*diagnosed, "--out", f"{run}/diagnosis", "--no-progress"]) == 0
