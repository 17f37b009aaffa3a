"""Diagnoses follow from their file alone: made-up losses against ratios said by hand; tables and the plot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from dual_system.analysis import diagnosis, tables
from dual_system.analysis.counterfactual import SCHEMA as COUNTERFACTUAL_SCHEMA
from dual_system.analysis.diagnosis import CONDITIONS, Losses, absolute, ratio, read_diagnosis
from protocol.errors import FileError

MODELS = {"ponder": {"is_untrained": False}, "pounce": {"is_untrained": False}}


def part(num_ticks: int, **loss: float) -> dict[str, Any]:
    return {"num_ticks": num_ticks, "loss": loss if num_ticks else {}}


def write(folder: Path, *, growth: float = 2.0, **changes: Any) -> Path:
    """Three episodes of two tasks whose loss at every age, and without cognition, is so many times that at 0.3 s."""
    episodes = []
    for task, seed, fresh, count in (("A", 0, 0.1, 4), ("A", 1, 0.3, 2), ("B", 0, 0.2, 6)):
        ages = {str(k): fresh * growth ** (k > 0) for k in (0, 1, 2, 4)}
        shares = {"real": fresh, "null": fresh * growth, "shuffled": fresh * 2 * growth}
        parts = {"staleness": part(count, **ages), "all": part(count, **shares), "branch": part(1, **shares)}
        episodes.append({"task": task, "seed": seed} | parts)
    found = {"schema": diagnosis.SCHEMA, "stale_by": [0, 1, 2, 4], "models": MODELS, "episodes": episodes}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / diagnosis.DIAGNOSIS).write_text(json.dumps(found | changes))
    return folder


@given(st.data())
@settings(max_examples=20)
def test_of_losses_that_grow_alike_everywhere_the_ratio_is_certain(data: st.DataObject) -> None:
    growth = data.draw(st.floats(0.5, 10))
    counts = data.draw(st.lists(st.integers(1, 5), min_size=1, max_size=3))
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    fresh = {str(task): rng.uniform(0.1, 1, count) for task, count in enumerate(counts)}
    losses = Losses(
        names=("a", "b"),
        means={task: np.stack([each, growth * each], 1) for task, each in fresh.items()},
        num_ticks={task: rng.integers(1, 9, len(each)).astype(np.float64) for task, each in fresh.items()},
    )
    found = ratio(losses, "b", "a")
    assert [found.value, found.low, found.high] == pytest.approx([growth] * 3)
    spread = absolute(losses, "a")
    assert spread.low <= spread.high
    every = np.concatenate(list(fresh.values()))
    assert every.min() - 1e-9 <= spread.value <= every.max() + 1e-9


def test_ticks_weigh_alike_whichever_episode_they_are_of(tmp_path: Path) -> None:
    losses = read_diagnosis(write(tmp_path)).parts["staleness"]
    assert (losses.total_ticks, losses.num_episodes) == (12, 3)
    assert absolute(losses, "0").value == pytest.approx((4 * 0.1 + 2 * 0.3 + 6 * 0.2) / 12)


def test_one_command_makes_tables_and_the_plot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write(Path("one")), write(Path("two"), growth=4.0)
    for out in ("made", "again"):
        assert tables.main(["one", "two", "--out", out]) == 0
    text = (tmp_path / "made" / "tables.md").read_text()
    assert "| one | 12 of 3 | 0.183 " in text
    assert "| 1.00x [1.00, 1.00] | 2.00x [2.00, 2.00] | 2.00x [2.00, 2.00] | 2.00x [2.00, 2.00] |" in text
    assert "| trained at 1 s (paper, another simulator) | 757 of 80 | 0.117 | 1.00x |  | 7.11x | 9.22x |" in text
    assert "| two | branch points | 3 of 3 |" in text
    assert "| 4.00x [4.00, 4.00] | 8.00x [8.00, 8.00] |" in text
    assert [(tmp_path / "again" / name).read_bytes() for name in ("tables.md", "staleness.png")] == [
        (tmp_path / "made" / name).read_bytes() for name in ("tables.md", "staleness.png")
    ]
    colours = {colour for _, colour in Image.open(tmp_path / "made" / "staleness.png").getcolors(1 << 20)}
    assert {(24, 84, 160), (190, 80, 20)} <= colours  # a curve each


def test_untrained_weights_are_named(tmp_path: Path) -> None:
    models = MODELS | {"pounce": {"is_untrained": True}}
    assert tables.main([str(write(tmp_path / "a", models=models)), "--out", str(tmp_path)]) == 0
    assert "**untrained weights.**" in (tmp_path / "tables.md").read_text()


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"schema": "other/1"}, "other/1"), ({"episodes": [{}]}, "task|staleness"), ({"models": 3}, "int")],
)
def test_what_is_no_diagnosis_is_refused(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(FileError, match=rf"diagnosis\.json is no diagnosis .*{words}"):
        read_diagnosis(write(tmp_path, **changes))


def test_without_a_tick_there_is_nothing_to_tell(tmp_path: Path) -> None:
    nothing = {"task": "A", "seed": 0} | {name: part(0) for name in ("staleness", "all", "branch")}
    losses = read_diagnosis(write(tmp_path, episodes=[nothing])).parts["all"]
    assert losses.names == CONDITIONS
    with pytest.raises(ValueError, match="no tick"):
        absolute(losses, "real")


def test_counterfactual_scores_are_told_task_by_task(tmp_path: Path) -> None:
    pairs = [{"task": "A", "score": 1.0}, {"task": "A", "score": 0.5}, {"task": "B", "score": 0.0}]
    found = {"schema": COUNTERFACTUAL_SCHEMA, "models": MODELS, "pairs": pairs}
    (tmp_path / "counterfactual.json").write_text(json.dumps(found))
    assert tables.main([str(tmp_path), "--out", str(tmp_path)]) == 0
    text = (tmp_path / "tables.md").read_text()
    assert "| A | 2 | 75.00 [50.0, 100.0] |" in text
    assert "| all | 3 | 50.00 " in text
