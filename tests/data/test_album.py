"""An album: every scene its own, and what is said of it is what its picture shows."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from dual_system.data.album import INSTRUCTION, REFUSED, Studio, main
from dual_system.data.dataset import Dataset
from dual_system.tasks.imitation.insert_peg import InsertPeg
from dual_system.tasks.scene import CUBE_COLORS
from dual_system.tasks.task import Task

NUM_SCENES = 24
_SAID = re.compile(r"(highlighted )?(\w+ cube|button) at <(\d+), (\d+)>")


@pytest.fixture(scope="module")
def studio() -> Iterator[Studio]:
    with closing(Studio("PickHighlight", 256)) as studio:
        yield studio


def test_the_picture_shows_what_is_said_where_it_is_said(studio: Studio) -> None:
    num_lit = 0
    for seed in range(NUM_SCENES):
        row, frames = studio.picture(seed)
        said = _SAID.findall(row.grounded_subgoal)
        assert ", ".join(f"{lit}{name} at <{y}, {x}>" for lit, name, y, x in said) == row.grounded_subgoal
        columns = [int(x) for *_, x in said]
        assert columns == sorted(columns)
        assert sum(name != "button" for _, name, *_ in said) <= 3 + seed % 3 + (seed % 3 == 2)
        num_lit += sum(bool(lit) for lit, *_ in said)
        for _, name, y, x in said:
            if name == "button":
                continue
            colour = np.array(CUBE_COLORS[name.split()[0]][:3])
            near = frames["front"][int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2].reshape(-1, 3).astype(float)
            # half hidden, the middle of what is seen of a cube may be the edge of a finger
            assert (near.argmax(axis=1) == colour.argmax()).any(), (seed, name, near)
    assert num_lit > 0


CUBES = {f"{name} cube" for name in CUBE_COLORS}
NAMED = {
    "ButtonUnmask": {*CUBES, "container", "button"},
    "VideoUnmaskSwap": {*CUBES, "container"},
    "PickXtimes": {*CUBES, "target", "button"},
    "BinFill": {*CUBES, "bin", "button"},
    "SwingXtimes": {*CUBES, "target", "button"},
    "VideoRepick": {*CUBES, "button"},
    "VideoPlaceButton": {*CUBES, "target", "button"},
    "VideoPlaceOrder": {*CUBES, "target", "button"},
    "StopCube": {"button", "target", "running cube"},
    "MoveCube": {"red cube", "target", "peg"},
    "PatternLock": {"grey target", "red target"},
    "RouteStick": {"grey target", "red target", "post"},
    "InsertPeg": {"box", "far end", "near end"},
}


@pytest.mark.parametrize("task", NAMED)
def test_other_tasks_name_their_things(task: str) -> None:
    """All of them, where the picture shows them: of what is said the colour is there, or what has none."""
    colours = {f"{name} cube": np.array(rgba[:3]) for name, rgba in CUBE_COLORS.items()}
    names = set()
    with closing(Studio(task, 256)) as studio:
        for seed in range(12):
            row, frames = studio.picture(seed)
            said = re.findall(r"([^,<>]+?) at <(\d+), (\d+)>", row.grounded_subgoal)
            names |= {name.strip() for name, _, _ in said}
            cubes = [(name.strip(), int(y), int(x)) for name, y, x in said if name.strip() in colours]
            for name, y, x in cubes:
                near = frames["front"][max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].reshape(-1, 3).astype(float)
                assert (near.argmax(axis=1) == colours[name].argmax()).any(), (seed, name, near)
            assert not (cubes and "container at" in row.grounded_subgoal), "no picture shows both"
    assert names == NAMED[task]


def test_demonstrations_are_pictured_while_they_last(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With what they leave behind: a target turns red where the stick is, and the stick is told of by its pose."""
    with closing(Studio("PatternLock", 256)) as studio:
        rows = [row for row, _ in studio.demonstrated(20, 10)]
        again = [row.grounded_subgoal for row, _ in studio.demonstrated(20, 10)]
        assert [row.grounded_subgoal for row in rows] == again
        reds = {place for row in rows for place in re.findall(r"red target at <(\d+, \d+)>", row.grounded_subgoal)}
        assert len(reds) > 1
        assert len({tuple(row.tcp_pose.tolist()) for row in rows}) == len(rows)
    arguments = ["--out", str(tmp_path / "album"), "--image-px", "128", "--no-progress", "--demonstrated"]
    assert main([*arguments, "--task", "PickXtimes", "--pictures", "1"]) == REFUSED
    assert "demonstrates nothing" in capsys.readouterr().err


def test_equal_seeds_are_equal_pictures_whatever_was_drawn_before(studio: Studio) -> None:
    row, frames = studio.picture(5)
    studio.picture(8)
    again, seen = studio.picture(5)
    assert row.grounded_subgoal == again.grounded_subgoal
    assert np.array_equal(row.state, again.state)
    assert np.array_equal(frames["front"], seen["front"])


def test_it_is_a_dataset_of_pages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--out", str(tmp_path / "album"), "--pictures", "1", "--image-px", "128", "--no-progress"]
    assert main(arguments) == 0
    assert "100 pictures" in capsys.readouterr().out
    (page,) = Dataset(tmp_path / "album").episodes
    assert (page.instruction, page.origin, page.num_rows) == (INSTRUCTION, "album", 100)
    rows = Dataset(tmp_path / "album").rows(0)
    assert rows.is_transition.all()
    assert len(set(rows.grounded_subgoal)) == 100
    assert main(arguments) == REFUSED
    assert "another --out" in capsys.readouterr().err


def test_a_task_that_names_nothing_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(InsertPeg, "things", Task.things)
    assert main(["--out", str(tmp_path), "--task", "InsertPeg"]) == REFUSED
    assert "'InsertPeg' does not name its things" in capsys.readouterr().err
