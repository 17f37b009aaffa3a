"""Pairs on disk are the pairs that were found, and the program writes what it says."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dual_system.analysis.counterfactual import p_own
from dual_system.tasks.pair_files import (
    INDEX,
    PairsOptions,
    demo_sampling_of,
    main,
    read_pairs,
    write_index,
    write_pair,
)
from dual_system.tasks.pairs import Pair, Telling
from dual_system.tasks.task import Task

rng = np.random.default_rng(0)


def pictures(*shape: int) -> dict[str, np.ndarray]:
    return {camera: rng.integers(0, 256, (*shape, 4, 4, 3), dtype=np.uint8) for camera in ("front", "wrist")}


def telling(num_frames: int) -> Telling:
    return Telling(
        frames=pictures(num_frames),
        states=rng.normal(size=(num_frames, 8)).astype(np.float32),
        steps=np.arange(num_frames) * 20,
        is_demonstration=np.arange(num_frames) < 1,
        oracle=rng.normal(size=(20, 8)).astype(np.float32),
        subgoal=f"pick up the {num_frames}th cube at <1, 2>",
        reasoning="",
    )


def pair(seed: int) -> Pair:
    return Pair(
        task="PickHighlight",
        family="reference",
        seed=seed,
        difficulty="easy",
        variant=0,
        is_cut=True,
        seam=0.25,
        instruction="pick it up",
        frames=pictures(),
        state=np.zeros(8, dtype=np.float32),
        own=telling(3),
        twin=telling(2),
    )


def assert_same(a: object, b: object) -> None:
    for field in dataclasses.fields(a):  # type: ignore[arg-type]
        ours, theirs = getattr(a, field.name), getattr(b, field.name)
        if dataclasses.is_dataclass(ours):
            assert_same(ours, theirs)
        else:
            np.testing.assert_equal(ours, theirs)


def test_a_written_pair_is_read_back(tmp_path: Path) -> None:
    written = [pair(7), pair(8)]
    write_index([write_pair(one, tmp_path) for one in written], tmp_path, demo_hz=2, demo_to_its_end=True)
    assert demo_sampling_of(tmp_path) == (2, True)
    for ours, theirs in zip(written, read_pairs(tmp_path), strict=True):
        assert_same(ours, theirs)


def test_another_schema_is_refused(tmp_path: Path) -> None:
    (tmp_path / INDEX).write_text('{"schema": "pairs/0", "pairs": []}')
    with pytest.raises(ValueError, match="schema 'pairs/0', expected 'ponderpounce-pairs/1'"):
        read_pairs(tmp_path)


@pytest.mark.sim
def test_the_program_writes_pairs_that_can_be_scored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--family", "reference", "--tasks", "PickHighlight", "--out", str(tmp_path), "--image-px", "32"]
    assert main([*arguments, "--pairs", "2"]) == 0
    assert "2 pairs of reference" in capsys.readouterr().out
    found = list(read_pairs(tmp_path))
    assert [one.task for one in found] == ["PickHighlight"] * 2
    script = np.stack([[one.own.oracle, one.twin.oracle] for one in found])
    assert p_own(script, script) == 1.0
    assert main([*arguments, "--pairs", "1"]) == 2
    assert "holds pairs already" in capsys.readouterr().err


def test_a_task_of_another_family_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--family", "counting", "--tasks", "PickHighlight", "--out", str(tmp_path)]
    assert main(arguments) == 2
    assert "PickHighlight: not of the counting family" in capsys.readouterr().err


def test_a_family_without_forks_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Task, "can_be_forked", classmethod(lambda cls: False))
    assert main(["--family", "imitation", "--out", str(tmp_path)]) == 2
    assert "no task of the imitation family can be forked" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (["--seed", "800000"], "only if it is named"),
        (["--seed", "2000000"], "the training data's"),
        (["--split", "development", "--seed", "7"], "of the demo split, not of development"),
    ],
)
def test_pairs_of_scenes_that_are_for_measurements_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], asked: list[str], words: str
) -> None:
    assert main(["--family", "reference", "--out", str(tmp_path), *asked]) == 2
    assert words in capsys.readouterr().err


def test_pairs_are_looked_for_to_the_end_of_their_split(tmp_path: Path) -> None:
    def seeds(**asked: Any) -> range:
        return PairsOptions(family="reference", out=tmp_path, **asked).seeds

    assert seeds() == range(500_000)
    assert seeds(split="development") == range(500_000, 800_000)
    assert seeds(seed=799_999) == range(799_999, 800_000)
