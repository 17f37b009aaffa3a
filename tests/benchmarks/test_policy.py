"""``make policy``: stages in their order, slices that end in time, and an account that adds up."""

from __future__ import annotations

import importlib
import inspect
import json
import os
import signal
import subprocess
import textwrap
import threading
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

import pytest

from benchmarks import policy
from benchmarks.policy_cost import CostOptions
from benchmarks.policy_plan import TASKS, stages
from benchmarks.slices import DONE, FAILED, UNFINISHED, Stage, account
from dual_system.data.collect import CollectOptions
from dual_system.data.correct import CorrectOptions
from dual_system.data.export import ExportOptions
from dual_system.policy.films import FilmsOptions
from dual_system.policy.towers import TowersOptions
from dual_system.tasks.pair_files import PairsOptions
from dual_system.training.probe import ProbeOptions
from dual_system.training.recipes import recipe
from dual_system.training.train import TrainOptions
from protocol.command_line import parse
from sim_client.condition import EvalOptions
from sim_client.counterfactual import CounterfactualOptions

OPTIONS: dict[str, Any] = {
    "benchmarks.policy_cost": CostOptions,
    "dual_system.data.collect": CollectOptions,
    "dual_system.data.correct": CorrectOptions,
    "dual_system.data.export": ExportOptions,
    "sim_client.evaluate": EvalOptions,
    "dual_system.policy.films": FilmsOptions,
    "dual_system.policy.towers": TowersOptions,
    "dual_system.tasks.pair_files": PairsOptions,
    "sim_client.counterfactual": CounterfactualOptions,
    "dual_system.training.probe": ProbeOptions,
    "dual_system.training.train": TrainOptions,
}


def test_every_command_of_every_stage_is_one_that_its_program_takes(tmp_path: Path) -> None:
    found = set()
    for stage in stages(tmp_path):
        for module, *arguments in stage.commands:
            options = parse(OPTIONS[module], arguments, prog=module)
            found.add(module)
            assert str(options.out).startswith(str(tmp_path))
            assert all(str(path).startswith(str(tmp_path)) for path in getattr(options, "files", ()))
            source = inspect.getsource(importlib.import_module(module))
            assert "\nif __name__ == " in source, f"-m {module} does nothing"
    assert found == OPTIONS.keys()


@pytest.mark.parametrize("tasks", [TASKS, ("VideoUnmask", "PickHighlight"), ("PickXtimes",)])
def test_a_stage_reads_only_what_an_earlier_one_writes(tmp_path: Path, tasks: Sequence[str]) -> None:
    written = {tmp_path / "pictures"}
    for stage in stages(tmp_path, tasks):
        outs = {Path(arguments[arguments.index("--out") + 1]) for _, *arguments in stage.commands}
        for _, *arguments in stage.commands:
            read = {Path(each) for each in arguments if each.startswith(str(tmp_path))} - outs
            assert all(path in written or written & set(path.parents) for path in read)
            if "--tasks" in arguments:
                told = arguments[arguments.index("--tasks") + 1 :]
                named = [*takewhile(lambda each: not each.startswith("--"), told)]
                assert named
                assert set(named) <= set(tasks)
        written |= outs


def test_every_row_is_played_with_what_its_pounce_reads(tmp_path: Path) -> None:
    """Null cognition takes a frame memory away too, so it is the pair's own control alone."""
    played = [parse(EvalOptions, arguments[1:], prog="pp-eval") for stage in stages(tmp_path)
              if stage.is_test or stage.name.startswith("delays") for arguments in stage.commands]  # fmt: skip
    kinds = set()
    for options in played:
        assert options.pounce_checkpoint is not None
        pounce = recipe(options.pounce_checkpoint.parent.name.rpartition("_")[0]).pounce
        told = options.condition.subgoal_text != "ponder"
        reads = pounce.cognition.num_carriers > 0 or (pounce.reads_subgoal and not told)
        assert (options.ponder_checkpoint is not None) == reads
        assert told <= pounce.reads_subgoal
        kinds.add((reads, told, options.condition.cognition))
    nulls = [each.out.name for each in played if each.condition.cognition == "null"]
    assert nulls == ["laptop_0_null", "laptop_1_null"]
    assert len(kinds) == 5


PROGRAM = """
    import signal, sys, time
    from pathlib import Path

    def interrupted(number, frame):
        raise KeyboardInterrupt

    def main(file, count):
        signal.signal(signal.SIGTERM, interrupted)
        done = int(file.read_text()) if file.exists() else 0
        try:
            while done < count:
                time.sleep(0.05)
                done += 1
        except KeyboardInterrupt:
            return 130
        finally:
            file.write_text(str(done))
        return 0

    if __name__ == "__main__":
        sys.exit(main(Path(sys.argv[1]), int(sys.argv[2])))
"""


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a module that counts, saves its count and resumes."""
    (tmp_path / "counting.py").write_text(textwrap.dedent(PROGRAM))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return tmp_path


def plan(folder: Path, monkeypatch: pytest.MonkeyPatch, *counts: int) -> None:
    def planned(*_: Any) -> tuple[Stage, ...]:
        return tuple(
            Stage(
                name=f"part {number}",
                commands=(("counting", f"{folder / f'{number}.txt'}", f"{count}"),),
            )
            for number, count in enumerate(counts)
        )

    monkeypatch.setattr(policy, "stages", planned)


def counted(folder: Path) -> int:
    file = folder / "0.txt"
    return int(file.read_text()) if file.exists() else 0


def entries(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "hours.jsonl").read_text().splitlines()]


def test_what_is_done_is_not_done_again(programs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan(programs, monkeypatch, 2, 3)
    assert policy.main(["--folder", str(programs)]) == DONE
    assert [entry["stage"] for entry in entries(programs)] == ["part 0", "part 1"]
    assert policy.main(["--folder", str(programs)]) == DONE
    assert len(entries(programs)) == 2


def test_a_slice_that_is_over_is_gone_on_with(programs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan(programs, monkeypatch, 1_000_000)
    while (reached := counted(programs)) == 0:  # on a busy machine a slice may end before Python has started
        assert policy.main(["--folder", str(programs), "--minutes", "0.02"]) == UNFINISHED
    slices = len(entries(programs))
    plan(programs, monkeypatch, reached + 1)
    assert policy.main(["--folder", str(programs)]) == DONE
    assert counted(programs) == reached + 1
    assert len(entries(programs)) == slices + 1


def test_a_signal_ends_the_slice_and_its_cost_is_counted(programs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan(programs, monkeypatch, 1_000_000)
    timer = threading.Timer(0.3, os.kill, args=(os.getpid(), signal.SIGTERM))
    timer.start()
    assert policy.main(["--folder", str(programs)]) == UNFINISHED
    timer.join()
    assert [entry["stage"] for entry in entries(programs)] == ["part 0"]


def test_a_command_that_ended_is_not_run_again_beside_one_that_did_not(
    programs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A finished training refuses to be started again: the stage would fail for ever."""
    short, long = programs / "short.txt", programs / "0.txt"

    def planned(count: int) -> None:
        commands = (("counting", f"{short}", "1"), ("counting", f"{long}", f"{count}"))
        monkeypatch.setattr(policy, "stages", lambda *_: (Stage(name="two", commands=commands),))

    planned(1_000_000)
    while not (programs / "done" / "two.0").exists():
        assert policy.main(["--folder", str(programs), "--minutes", "0.02"]) == UNFINISHED
    short.write_text("not a number: a second run would fail")
    planned(counted(programs) + 1)
    assert policy.main(["--folder", str(programs)]) == DONE


def test_no_more_commands_run_at_once_than_there_are_cores(programs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    most, opened = 0, subprocess.Popen
    running: set[Any] = set()

    def counting(*arguments: Any, **options: Any) -> Any:
        nonlocal most
        running.difference_update([each for each in running if each.poll() is not None])
        running.add(process := opened(*arguments, **options))
        most = max(most, len(running))
        return process

    monkeypatch.setattr(subprocess, "Popen", counting)
    commands = tuple(("counting", f"{programs / f'{number}.txt'}", "2") for number in range(3))
    monkeypatch.setattr(policy, "stages", lambda *_: (Stage(name="three", commands=commands),))
    assert policy.main(["--folder", str(programs)]) == DONE
    assert most == 1


@pytest.mark.parametrize(("cores", "num_commands", "threads"), [(2, 1, "2"), (2, 2, "1"), (8, 3, "2"), (2, 5, "1")])
def test_commands_share_the_cores(
    programs: Path, monkeypatch: pytest.MonkeyPatch, cores: int, num_commands: int, threads: str
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    given, opened = [], subprocess.Popen

    def noting(*arguments: Any, env: dict[str, str], **options: Any) -> Any:
        given.append(env["OMP_NUM_THREADS"])
        return opened(*arguments, env=env, **options)

    monkeypatch.setattr(subprocess, "Popen", noting)
    commands = tuple(("counting", f"{programs / f'{number}.txt'}", "1") for number in range(num_commands))
    monkeypatch.setattr(policy, "stages", lambda *_: (Stage(name="some", commands=commands),))
    assert policy.main(["--folder", str(programs)]) == DONE
    assert given == [threads] * num_commands


def test_a_command_that_fails_ends_the_slice(
    programs: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    failing = Stage(name="broken", commands=(("counting", "no", "number"),))
    monkeypatch.setattr(policy, "stages", lambda *_: (failing,))
    assert policy.main(["--folder", str(programs)]) == FAILED
    assert "broken ended with [1]" in capfd.readouterr().err


def test_the_account_is_the_sum_of_its_slices(tmp_path: Path) -> None:
    lines = [{"stage": name, "wall_s": 1800.0, "core_s": 3600.0} for name in ("towers", "joint", "towers")]
    (tmp_path / "hours.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in account(tmp_path).splitlines()]
    assert rows[2:] == [["towers", "2", "1.00", "2.00"], ["joint", "1", "0.50", "1.00"], ["all", "3", "1.50", "3.00"]]
