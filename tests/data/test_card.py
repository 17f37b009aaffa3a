"""The card counts what is there, and every task has its line of pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from dual_system.data.card import CARD, LABEL_PX, PICTURE_PX, PICTURES_PER_TASK, SHEET, main
from dual_system.data.episode import Package, unpack
from dual_system.data.lerobot_v3 import DatasetWriter


@pytest.fixture
def folder(tmp_path: Path, package: Callable[..., Package]) -> Path:
    writer = DatasetWriter(tmp_path)
    for seed, task, difficulty in ((1, "Counting", "easy"), (2, "Counting", "hard"), (3, "Waiting", "easy")):
        writer.add(unpack(package(seed, num_rows=3 + seed, task=task, difficulty=difficulty, recovery="z")))
    writer.finish()
    return tmp_path


def test_every_task_is_counted(folder: Path) -> None:
    assert main([str(folder)]) == 0
    text = (folder / CARD).read_text()
    assert "# 3 episodes of 2 memory tasks" in text
    assert "| Counting | 2 | 1 / 0 / 1 | 2 | 2 (2 to 3) | 1.0 | 2 | 0 |" in text
    assert "| Waiting | 1 | 1 / 0 / 0 | 2 | 4 (4 to 4) | 1.0 | 1 | 0 |" in text
    assert f"({SHEET})" in text


def test_every_task_is_shown(folder: Path) -> None:
    main([str(folder)])
    with Image.open(folder / SHEET) as sheet:
        assert sheet.size == (PICTURES_PER_TASK * PICTURE_PX, 2 * (PICTURE_PX + LABEL_PX))


def test_what_is_no_dataset_has_no_card(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path)]) == 2
    assert "pp-collect makes one" in capsys.readouterr().err
