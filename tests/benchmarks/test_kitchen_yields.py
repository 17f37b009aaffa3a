"""Yields are kept task by task, and a killed run goes on; what is played is what the split says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import kitchen_yields as module
from benchmarks import report
from benchmarks.render import render, reports_in
from dual_system.tasks.kitchen.catalogue import TASKS
from dual_system.tasks.kitchen.environment import KitchenEnvironment, instances_of
from dual_system.tasks.kitchen.goals import GOAL_SETS
from dual_system.tasks.task import TaskError

NAMES = ("OpenDrawer", "CloseDrawer", "TwoDrawers")


class Script:
    """Solves even seeds; dies when it is to play the ``dies_at``-th task."""

    def __init__(self, dies_at: int | None = None) -> None:
        self.asked: list[tuple[str, range]] = []
        self._dies_at = dies_at

    def __call__(self, name: str, seeds: range, num_pairs: int) -> dict[str, Any]:
        if len(self.asked) == self._dies_at:
            raise KeyboardInterrupt
        self.asked.append((name, seeds))
        failed = {str(seed): "goal missed" for seed in seeds if seed % 2}
        return {
            "seeds": [seeds[0], seeds[-1]], "solved": len(seeds) - len(failed), "failed": failed,
            "steps": [seed % 7 for seed in seeds], "cpu_s": 1.5, "pair_cpu_s": [4.0] * num_pairs,
            "step_cpu_ms": [7.0, 8.0, 9.0],
        }  # fmt: skip


def run(monkeypatch: pytest.MonkeyPatch, script: Script, out: Path, *more: str) -> int:
    monkeypatch.setattr(module, "played", script)
    return module.main(["--out", str(out), "--tasks", *NAMES, "--seeds", "5", *more])


def test_a_killed_run_goes_on_and_ends_as_one_that_was_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, cut = tmp_path / "whole.json", tmp_path / "new" / "cut.json"
    assert run(monkeypatch, Script(), whole) == 0
    expected = capsys.readouterr().out
    assert run(monkeypatch, Script(dies_at=2), cut) == 130
    assert list(json.loads(cut.read_text())["tasks"]) == list(NAMES[:2])
    capsys.readouterr()
    rest = Script()
    assert run(monkeypatch, rest, cut) == 0
    assert [name for name, _ in rest.asked] == [NAMES[2]]
    assert capsys.readouterr().out == expected
    assert cut.read_bytes() == whole.read_bytes()
    assert "| OpenDrawer  | 3/5       | 60.00 [23.1, 88.2]" in expected
    assert "- CloseDrawer, 2 failed: goal missed (seeds 1, 3)" in expected


def test_other_scenes_are_not_added_to_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, Script(), tmp_path / "a.json") == 0
    assert run(monkeypatch, Script(), tmp_path / "a.json", "--split", "development") == 2
    assert "was begun with {'seeds': 5, 'split': 'demo', 'pairs': 2}" in capsys.readouterr().err


def test_a_report_is_one_that_is_rendered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "REPORTS", tmp_path / "reports")
    assert run(monkeypatch, Script(), tmp_path / "a.json") == 0
    assert not (tmp_path / "reports").exists()
    assert run(monkeypatch, Script(), tmp_path / "a.json", "--report") == 0
    page = render(reports_in(tmp_path / "reports"))
    assert "| OpenDrawer  | 3/5 " in page
    assert str(tmp_path) not in page


def test_a_row_has_the_spread_of_the_steps() -> None:
    (row,) = module.table({"OpenDrawer": Script()("OpenDrawer", range(5), 2)})
    assert (row["n"], row["p50_step_cpu_ms"], row["max_step_cpu_ms"]) == (3, 8.0, 9.0)


@pytest.mark.sim
def test_steps_are_timed_with_pictures_after_the_first_ones() -> None:
    cpu_ms = module.stepped_ms("CoffeePressButton", 0)
    assert 50 <= len(cpu_ms) <= 100
    assert min(cpu_ms) > 0


@pytest.mark.parametrize(("split", "instances"), [("demo", "A"), ("development", "B")])
def test_a_split_shows_its_instances(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, split: str, instances: str
) -> None:
    script = Script()
    assert run(monkeypatch, script, tmp_path / "a.json", "--split", split) == 0
    seeds = {seed for _, seeds in script.asked for seed in seeds}
    assert len(seeds) == 5
    assert {instances_of(seed) for seed in seeds} == {instances}


def test_the_tasks_are_the_twenty_four_and_the_sets_if_asked(tmp_path: Path) -> None:
    out = tmp_path / "a.json"
    assert module.YieldOptions(out=out).names() == tuple(TASKS)
    assert module.YieldOptions(out=out, goal_sets=True).names() == (*TASKS, *GOAL_SETS)
    assert module.YieldOptions(out=out, tasks=("OpenDrawer", "OpenDrawer")).names() == ("OpenDrawer",)
    with pytest.raises(TaskError, match="unknown kitchen task 'StopCube'"):
        module.YieldOptions(out=out, tasks=("StopCube",)).names()


def test_an_outcome_is_the_environments(monkeypatch: pytest.MonkeyPatch) -> None:
    with KitchenEnvironment("CoffeePressButton", render=False) as environment:
        why_not, steps = module.outcome(environment, 0)
        assert why_not == ""
        assert environment.goal_done == 0
        monkeypatch.setattr(environment, "oracle", lambda: iter([[0.0] * 12] * 3))
        why_not, shorter = module.outcome(environment, 0)
        assert "the script ended" in why_not
        assert shorter == 3 < steps
