"""``make kitchen``: its commands are ones that their programs take, and rows differ in what the issue names alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.kitchen_policy import CONDITIONS, ROWS, stages
from dual_system.data.kitchen import KitchenOptions
from dual_system.tasks.kitchen.goals import GOAL_SETS
from dual_system.training.recipes import recipe
from dual_system.training.train import TrainOptions
from protocol.command_line import parse
from sim_client.condition import EvalOptions

OPTIONS: dict[str, Any] = {
    "dual_system.data.kitchen": KitchenOptions,
    "dual_system.training.train": TrainOptions,
    "sim_client.evaluate": EvalOptions,
}


def test_a_stage_s_commands_are_taken_and_read_only_what_an_earlier_one_writes(tmp_path: Path) -> None:
    written = {tmp_path / "pictures"}
    for stage in stages(tmp_path):
        outs = set()
        for module, *arguments in stage.commands:
            options = parse(OPTIONS[module], arguments, prog=module)
            read = {Path(each) for each in arguments if each.startswith(str(tmp_path))} - {options.out}
            assert all(written & {path, *path.parents} for path in read)
            outs.add(options.out)
        written |= outs


def test_test_scenes_are_played_after_all_training(tmp_path: Path) -> None:
    *before, last = stages(tmp_path)
    assert last.is_test
    played = [parse(EvalOptions, arguments[1:], prog="pp-eval") for arguments in last.commands]
    assert [each.out.name for each in played] == [*CONDITIONS]
    assert {each.split for each in played} == {"test"}
    assert all(set(each.task_names()) == GOAL_SETS.keys() for each in played)
    assert all(arguments[0] != "sim_client.evaluate" for stage in before for arguments in stage.commands)


def test_every_row_is_played_with_what_its_pounce_reads(tmp_path: Path) -> None:
    for arguments in stages(tmp_path)[-1].commands:
        options = parse(EvalOptions, arguments[1:], prog="pp-eval")
        assert options.pounce_checkpoint is not None
        pounce = recipe(options.pounce_checkpoint.parent.name).pounce
        assert (options.ponder_checkpoint is not None) == (pounce.cognition.num_carriers > 0)
        assert (options.condition.subgoal_text != "ponder") == pounce.reads_subgoal


def test_rows_have_the_same_chances() -> None:
    runs = [row() for row in ROWS]
    same = {(run.num_steps, run.batch_episodes, run.train, run.example.clocks, run.example.max_invocations)
            for run in runs}  # fmt: skip
    assert len(same) == 1
    assert {run.w2 for run in runs} == {0.0}
