"""What a run shows: its log, and texts beside the texts of the data."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.context import IGNORE, ContextFormat, Transition
from dual_system.models.ponder.network import Ponder
from dual_system.training.joint import PonderBatch
from dual_system.training.trainer import StepReport
from dual_system.training.watch import Watch, samples_of


@pytest.fixture(scope="module")
def form() -> ContextFormat:
    return Ponder.random(replace(tiny_cpu(), image_px=(32, 32), num_layers=4), seed=1).format


def test_what_ponder_writes_stands_beside_what_it_should(form: ContextFormat) -> None:
    v = form.vocabulary
    row = form.row([*form.opening("go"), *form.query(1, Transition(subgoal=v.encode("pick"))), *form.query(1)])
    wanted = [target for target in row.targets if target != IGNORE]
    right = samples_of(row, torch.tensor(wanted), v)
    assert all(sample.target == sample.predicted for sample in right)
    assert any("pick" in sample.target for sample in right)
    wrong = samples_of(row, torch.tensor([v.t_no] * len(wanted)), v)
    assert [sample.target for sample in wrong] == [sample.target for sample in right]
    assert wrong != right


def test_without_texts_there_are_no_samples(form: ContextFormat) -> None:
    row = form.row([*form.opening("go"), *form.query(1)])
    assert samples_of(row, torch.zeros(0, dtype=torch.int64), form.vocabulary) == []


def test_a_resumed_run_drops_what_it_will_write_again(tmp_path: Path) -> None:
    lines = [json.dumps({"step": step}) + "\n" for step in (0, 1, 2)]
    (tmp_path / "log.jsonl").write_text("".join(lines) + '{"step": 3')  # killed while writing the last line
    with Watch(tmp_path, first_step=2, sample_every=1, tensorboard=False):
        pass
    assert (tmp_path / "log.jsonl").read_text() == "".join(lines[:2])


def test_tensorboard_that_is_not_installed_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ValueError, match="pip install tensorboard"):
        Watch(tmp_path, first_step=0, sample_every=1, tensorboard=True)


@pytest.mark.filterwarnings("ignore")
def test_tensorboard_gets_scalars_texts_and_pictures(tmp_path: Path, form: ContextFormat) -> None:
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    row = form.row([*form.opening("go"), *form.query(1, Transition(subgoal=form.vocabulary.encode("pick")))])
    predicted_N = torch.tensor([target for target in row.targets if target != IGNORE])
    episodes = PonderBatch(rows=(row,), frames=(torch.zeros(1, 32, 32, 3, dtype=torch.uint8),))
    format_only = SimpleNamespace(ponder=SimpleNamespace(format=form))
    trainer: Any = SimpleNamespace(latest=(episodes, predicted_N), model=format_only)
    report = StepReport(
        step=0,
        total=2.5,
        flow_matching=1.0,
        grounding=1.5,
        gradient_norm=1.0,
        num_supervised=3,
        num_null=0,
    )
    with Watch(tmp_path, first_step=0, sample_every=1, tensorboard=True) as watch:
        watch.step(report, trainer)
    board = events.EventAccumulator(str(tmp_path / "tensorboard"))
    board.Reload()
    assert board.Scalars("loss/total")[0].value == 2.5
    assert "ponder/last_picture" in board.Tags()["images"]
    assert any("ponder/text" in tag for tag in board.Tags()["tensors"])
