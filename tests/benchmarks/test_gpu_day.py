"""A borrowed GPU's day: wired on a CPU at tiny size, resumed after a kill, honest about what failed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import gpu_day
from benchmarks.gpu_day import main
from benchmarks.gpu_stages import PREDICTED_MS, STAGES, Day, Stage

CPU = ("--device", "cpu", "--size", "tiny")


def rows(folder: Path) -> dict[str, Any]:
    found = json.loads((folder / "gpu_day.json").read_text())["stages"]
    return {stage: part["rows"] for stage, part in found.items()}


@pytest.mark.slow
def test_every_stage_runs_on_a_cpu_at_tiny_size(tmp_path: Path) -> None:
    assert main(["--stage", "all", *CPU, "--out", str(tmp_path)]) == 0
    found = rows(tmp_path)
    assert list(found) == list(STAGES)
    assert found["ponder_right"]["captured float32"] < 1e-5
    assert found["pounce"]["pi0.5 fused against eager, mean"] < 1e-5
    assert found["probe"]["a triangular solve, captured"]["is_right"]
    assert json.loads((tmp_path / "gpu_day.json").read_text())["predicted_p50_ms"] == PREDICTED_MS


@pytest.mark.parametrize("killed", range(len(STAGES)))
def test_a_killed_call_keeps_its_rows_and_the_next_goes_on(
    killed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[str] = []
    is_killed = [True]

    def stage(name: str) -> Stage:
        def work(day: Day) -> None:
            """A stage."""
            ran.append(name)
            day.row("first", lambda: 1)
            if is_killed[0] and name == list(STAGES)[killed]:
                raise KeyboardInterrupt
            day.row("second", lambda: 2)

        return Stage(work, 1)

    names = list(STAGES)
    monkeypatch.setattr(gpu_day, "STAGES", {name: stage(name) for name in names})
    with pytest.raises(KeyboardInterrupt):
        main([*CPU, "--out", str(tmp_path)])
    assert rows(tmp_path)[names[killed]] == {"first": 1}
    is_killed[0] = False
    ran.clear()
    assert main([*CPU, "--out", str(tmp_path)]) == 0
    assert ran == names[killed:]
    assert rows(tmp_path) == {name: {"first": 1, "second": 2} for name in names}


def test_what_fails_is_a_row_and_the_rest_goes_on(tmp_path: Path) -> None:
    day = Day(torch.device("cpu"), "tiny", tmp_path / "probe.json")

    def broken() -> None:
        raise ValueError("no such thing")

    assert day.row("one", broken) is None
    assert day.row("two", lambda: 2) == 2
    day.write(is_over=True)
    assert day.rows["one"]["FAILED"] == "ValueError: no such thing"
    assert main(["--stage", "probe", *CPU, "--out", str(tmp_path)]) == 1


def test_what_a_cpu_measured_is_not_taken_for_a_gpu_s(tmp_path: Path) -> None:
    Day(torch.device("cpu"), "tiny", tmp_path / "probe.json").write(is_over=True)
    assert gpu_day._has_ended(tmp_path / "probe.json", torch.device("cpu"), "tiny")
    assert not gpu_day._has_ended(tmp_path / "probe.json", torch.device("cpu"), "full")
    assert not gpu_day._has_ended(tmp_path / "probe.json", torch.device("cuda", 0), "tiny")


def test_a_stage_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--stage", "probe,pond", *CPU])
    assert "--stage pond: expected all, or some of probe,kernels" in capsys.readouterr().err
