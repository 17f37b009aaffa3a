"""Wandering things: words follow the thing, everything moves, and equal seeds are equal films."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from dual_system.data.dataset import Dataset
from dual_system.data.episode import WANDERING, EpisodeWriter, Rows, unpack
from dual_system.data.video import FPS
from dual_system.data.wander import REFUSED, Wanderers, main
from dual_system.tasks.imitation.insert_peg import InsertPeg
from dual_system.tasks.scene import CUBE_COLORS
from dual_system.tasks.task import Task

LOOKS = 9
_SAID = re.compile(r"pick up the (?:\w+ )?highlighted cube at <(\d+), (\d+)>, which is (\w+)")


@pytest.fixture(scope="module")
def wanderers() -> Iterator[Wanderers]:
    with closing(Wanderers("PickHighlight", 256)) as made:
        yield made


def film(wanderers: Wanderers, seed: int) -> tuple[Rows, list[dict[str, np.ndarray]]]:
    """Its rows, and the pictures of its looks."""
    frames: list[dict[str, np.ndarray]] = []

    class Watching(EpisodeWriter):
        def add(self, row, pictures):  # type: ignore[no-untyped-def]
            if pictures:
                frames.append(dict(pictures))
            super().add(row, pictures)

    writer = Watching(256)
    about = wanderers.film(seed, LOOKS, writer)
    return unpack(writer.pack(about)).rows, frames


def test_the_thing_is_where_it_is_said_to_be_at_every_look(wanderers: Wanderers) -> None:
    num_right = num_told = 0
    for seed in range(6):
        rows, frames = film(wanderers, seed)
        assert rows.is_rendered.nonzero()[0].tolist() == list(range(0, LOOKS * FPS, FPS))
        for look, seen in enumerate(frames):
            texts = set(rows.grounded_subgoal[look * FPS : (look + 1) * FPS])
            assert len(texts) == 1
            said = _SAID.fullmatch(texts.pop())
            if said is None:
                continue  # hidden when it was first spoken of
            y, x, colour = int(said[1]), int(said[2]), np.array(CUBE_COLORS[said[3]][:3])
            near = seen["front"][y - 1 : y + 2, x - 1 : x + 2].reshape(-1, 3).astype(float)
            num_right += bool((near.argmax(axis=1) == colour.argmax()).any())
            num_told += 1
    assert num_told > 30
    assert num_right > 0.8 * num_told  # what the arm hides keeps its last place


def test_places_change_within_a_stint_and_stints_end(wanderers: Wanderers) -> None:
    moved_px, stints = [], 0
    for seed in range(6):
        rows, _ = film(wanderers, seed)
        stints += int(rows.is_transition.sum())
        told = [_SAID.fullmatch(rows.grounded_subgoal[look * FPS]) for look in range(LOOKS)]
        for look in range(1, LOOKS):
            before, after = told[look - 1], told[look]
            if before and after and not rows.is_transition[look * FPS]:
                assert rows.subgoal[look * FPS] == rows.subgoal[(look - 1) * FPS]
                moved_px.append(np.hypot(int(before[1]) - int(after[1]), int(before[2]) - int(after[2])))
    assert np.mean(np.array(moved_px) > 2) > 0.4
    assert max(moved_px) < 40
    assert 6 < stints < 6 * LOOKS


def test_equal_seeds_are_equal_films(wanderers: Wanderers) -> None:
    rows, frames = film(wanderers, 3)
    film(wanderers, 4)
    again, seen = film(wanderers, 3)
    assert rows.grounded_subgoal == again.grounded_subgoal
    np.testing.assert_array_equal(rows.state, again.state)
    assert all(np.array_equal(a["front"], b["front"]) for a, b in zip(frames, seen, strict=True))


def test_it_is_a_dataset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--out", str(tmp_path), "--episodes", "2", "--looks", "3", "--image-px", "128", "--no-progress"]
    assert main(arguments) == 0
    assert "2 episodes of 3 looks" in capsys.readouterr().out
    assert [(each.num_rows, each.origin) for each in Dataset(tmp_path).episodes] == [(3 * FPS, WANDERING)] * 2
    assert main(arguments) == REFUSED
    assert "another --out" in capsys.readouterr().err


def test_a_task_that_names_nothing_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(InsertPeg, "things", Task.things)
    assert main(["--out", str(tmp_path), "--task", "InsertPeg"]) == REFUSED
    assert "does not name its things" in capsys.readouterr().err
