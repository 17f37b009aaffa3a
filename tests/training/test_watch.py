"""What a run shows: words beside words, and a plot."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.context import IGNORE, ContextFormat, Transition
from dual_system.models.ponder.network import Ponder
from dual_system.training.joint import PonderBatch
from dual_system.training.plot import PANEL_PX, WIDTH_PX, plot_log, smoothed
from dual_system.training.trainer import StepReport
from dual_system.training.watch import Watch, samples_of


@pytest.fixture(scope="module")
def form() -> ContextFormat:
    return Ponder.random(replace(tiny_cpu(), image_px=(32, 32), num_layers=4), seed=1).format


def test_what_is_said_stands_beside_what_is_wanted(form: ContextFormat) -> None:
    v = form.vocabulary
    row = form.row([*form.opening("go"), *form.query(1, Transition(subgoal=v.encode("pick"))), *form.query(1)])
    wanted = [target for target in row.targets if target != IGNORE]
    right = samples_of(row, torch.tensor(wanted), v)
    assert all(sample.wanted == sample.said for sample in right)
    assert any("pick" in sample.wanted for sample in right)
    wrong = samples_of(row, torch.tensor([v.t_no] * len(wanted)), v)
    assert [sample.wanted for sample in wrong] == [sample.wanted for sample in right]
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


def _log(folder: Path, grounding: float) -> Path:
    lines = [
        {"step": step, "total": 2.0 / (step + 1), "flow_matching": 0.5, "grounding": grounding, "gradient_norm": 1.0}
        for step in range(50)
    ]
    path = folder / "log.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


@pytest.mark.parametrize(("grounding", "num_panels"), [(0.3, 4), (0.0, 3)])
def test_a_plot_has_a_panel_for_each_curve_that_is_not_zero(tmp_path: Path, grounding: float, num_panels: int) -> None:
    plot_log(_log(tmp_path, grounding), tmp_path / "run.png")
    picture = Image.open(tmp_path / "run.png")
    assert picture.size == (WIDTH_PX, num_panels * PANEL_PX)
    panels = np.split(np.asarray(picture), num_panels)
    assert all((panel == (24, 84, 160)).all(axis=-1).sum() > 300 for panel in panels)  # a dark line through each


def test_an_empty_log_is_refused(tmp_path: Path) -> None:
    (tmp_path / "log.jsonl").write_text("")
    with pytest.raises(ValueError, match="no steps"):
        plot_log(tmp_path / "log.jsonl", tmp_path / "run.png")


def test_smoothing_keeps_a_constant() -> None:
    np.testing.assert_allclose(smoothed([3.0] * 7), 3.0)


def test_tensorboard_that_is_not_installed_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ValueError, match="pip install tensorboard"):
        Watch(tmp_path, first_step=0, sample_every=1, tensorboard=True)


@pytest.mark.filterwarnings("ignore")
def test_tensorboard_gets_scalars_words_and_pictures(tmp_path: Path, form: ContextFormat) -> None:
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    row = form.row([*form.opening("go"), *form.query(1, Transition(subgoal=form.vocabulary.encode("pick")))])
    said_N = torch.tensor([target for target in row.targets if target != IGNORE])
    episodes = PonderBatch(rows=(row,), frames=(torch.zeros(1, 32, 32, 3, dtype=torch.uint8),))
    format_only = SimpleNamespace(ponder=SimpleNamespace(format=form))
    trainer: Any = SimpleNamespace(latest=(episodes, said_N), model=format_only)
    report = StepReport(
        step=0,
        total=2.5,
        flow_matching=1.0,
        grounding=1.5,
        alignment=0.0,
        placing=0.0,
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
    assert any("ponder/said" in tag for tag in board.Tags()["tensors"])
