"""A recorded oracle episode, exported, has the rows that collecting the same episode has, tick by tick."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dual_system.data import export as module
from dual_system.data.dataset import Dataset
from dual_system.data.episode import CAMERAS, Row
from dual_system.data.errors import DatasetError
from dual_system.data.export import ExportOptions, export, main, read_episode
from dual_system.data.jobs import Job, Look
from dual_system.data.recorded import logs_in
from dual_system.data.rollout import play
from dual_system.tasks.environment import make_environment
from protocol.mcap_log import EpisodeRecord, read_log
from sim_client.config import LogOptions

SEED, TASK = 3, "VideoUnmask"
JOB = Job(task=TASK, slot=0, image_px=256, max_steps=1300, look=Look())

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def log(recorded: Callable[..., Path]) -> Path:
    return recorded(TASK, SEED, LogOptions(pixels="exact"))


@pytest.fixture(scope="module")
def record(log: Path) -> EpisodeRecord:
    return read_log(log)


@pytest.fixture(scope="module")
def exported(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    out = tmp_path_factory.mktemp("exported") / "dataset"
    assert export(ExportOptions(files=(log,), out=out, progress=False)) == (1, [])
    return Dataset(out)


@pytest.fixture(scope="module")
def collected() -> list[Row]:
    rows: list[Row] = []
    with make_environment(TASK, render=False) as environment:
        play(environment, JOB, SEED, take=lambda row, frames: rows.append(row))
    return rows


def begun(record: EpisodeRecord, num_ticks: int) -> EpisodeRecord:
    """What a log holds of an episode that was left after so many ticks."""
    return dataclasses.replace(record, ticks=record.ticks[:num_ticks], result=None)


def test_a_folder_stands_for_all_logs_below_it(
    log: Path, record: EpisodeRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = read_episode(log, begun(record, 2), demonstration_hz=1)
    monkeypatch.setattr(module, "read_episode", lambda path, record, **options: short)
    for name in ("deep/b.mcap", "a.mcap"):
        (tmp_path / "logs" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "logs" / name).symlink_to(log)
    assert logs_in([log, tmp_path / "logs"]) == [log, *(tmp_path / "logs" / name for name in ("a.mcap", "deep/b.mcap"))]
    assert export(ExportOptions(files=(tmp_path / "logs",), out=tmp_path / "all", progress=False)) == (2, [])
    (tmp_path / "none").mkdir()
    with pytest.raises(DatasetError, match=r"none holds no \.mcap log; record with pp-eval --record"):
        export(ExportOptions(files=(tmp_path / "none",), out=tmp_path / "out", progress=False))


def test_every_row_is_the_collected_one(exported: Dataset, collected: list[Row]) -> None:
    rows = exported.rows(0)
    assert len(rows) == len(collected)
    for name in ("state", "action", "tcp_pose", "is_demonstration", "is_transition"):
        expected = np.stack([getattr(row, name) for row in collected])
        np.testing.assert_array_equal(getattr(rows, name), expected, err_msg=name)
    for name in ("subgoal", "grounded_subgoal", "demonstration_reasoning"):
        assert getattr(rows, name) == tuple(getattr(row, name) for row in collected)
    assert rows.is_rendered.all()


@pytest.fixture(scope="module")
def rounds(recorded: Callable[..., Path]) -> Path:
    """Of a task with several subgoals; nobody looks at its pictures."""
    return recorded("PickXtimes", SEED, LogOptions(record_hz=1))


@pytest.mark.parametrize("name", ["log", pytest.param("rounds", marks=pytest.mark.acceptance)])
def test_played_again_its_texts_are_those_that_collecting_tells(name: str, request: pytest.FixtureRequest) -> None:
    path: Path = request.getfixturevalue(name)
    record = read_log(path)
    rows: list[Row] = []
    with make_environment(record.info.task, render=False, texts_follow=True) as environment:
        job = dataclasses.replace(JOB, task=record.info.task)
        play(environment, job, SEED, take=lambda row, frames: rows.append(row))
    again = read_episode(path, record, texts="follow", demonstration_hz=1)
    assert again.rows.grounded_subgoal == tuple(row.grounded_subgoal for row in rows)
    assert again.rows.subgoal == tuple(row.subgoal for row in rows)
    assert again.rows.is_transition.tolist() == [row.is_transition for row in rows]


def test_an_episode_that_ends_early_is_exported_up_to_its_end(rounds: Path) -> None:
    record, at = read_log(rounds), 40
    cut = read_episode(rounds, begun(record, at), texts="follow")
    assert not cut.about.is_success
    assert len(cut.rows) == at
    whole = read_episode(rounds, record, texts="follow")
    assert cut.rows.grounded_subgoal == whole.rows.grounded_subgoal[:at]


def test_demonstrations_are_looked_at_as_often_as_asked_for(log: Path, record: EpisodeRecord) -> None:
    rows = read_episode(log, record, demonstration_hz=2).rows
    shown = np.flatnonzero(rows.is_demonstration & rows.is_rendered)
    assert len(shown) > 2
    last = int(rows.is_demonstration.sum()) - 1
    assert shown.tolist() == sorted({*range(0, last + 1, 10), last}), "and how it ends is looked at"
    assert rows.is_rendered[~rows.is_demonstration].all()


def test_what_goes_otherwise_here_is_refused(log: Path, record: EpisodeRecord) -> None:
    moved = dataclasses.replace(record.observations[9], proprio=record.observations[9].proprio + 1e-3)
    other = dataclasses.replace(record, observations=[*record.observations[:9], moved, *record.observations[10:]])
    with pytest.raises(DatasetError, match="at tick 9 the robot stands"):
        read_episode(log, other, texts="follow", demonstration_hz=1)


def test_it_says_where_the_episode_is_from(exported: Dataset) -> None:
    (entry,) = exported.episodes
    assert (entry.task, entry.seed, entry.difficulty, entry.origin) == (TASK, SEED, "easy", "oracle")
    assert entry.is_success


def test_pictures_are_the_ones_of_their_ticks(exported: Dataset, record: EpisodeRecord) -> None:
    num_shown = exported.episodes[0].num_demonstration_rows
    last = len(record.ticks) - 1
    for camera_index, camera in enumerate(CAMERAS):
        for tick, picture in zip((0, last), exported.frames(0, camera, [num_shown, num_shown + last]), strict=True):
            image = record.observations[tick].images[camera_index]
            exact = np.frombuffer(image.data, np.uint8).reshape(256, 256, 3)
            assert np.abs(picture.astype(float) - exact).mean() < 4  # what the codec takes


@pytest.mark.parametrize(("field", "said"), [("ticks", "account"), ("observations", "observation")])
def test_a_log_with_a_gap_is_refused(log: Path, record: EpisodeRecord, field: str, said: str) -> None:
    kept = [each for each in getattr(record, field) if each.tick != 7]
    with pytest.raises(DatasetError, match=rf"lacks the {said} of ticks \[7\]"):
        read_episode(log, dataclasses.replace(record, **{field: kept}))


def test_a_log_of_another_scene_is_refused(log: Path, record: EpisodeRecord) -> None:
    moved = dataclasses.replace(record.observations[0], proprio=record.observations[0].proprio + 1e-3)
    other = dataclasses.replace(record, observations=[moved, *record.observations[1:]])
    with pytest.raises(DatasetError, match="export it with those versions"):
        read_episode(log, other)


def test_nothing_is_overwritten(log: Path, exported: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(log), "--out", str(exported.root), "--no-progress"]) == 2
    assert "another --out" in capsys.readouterr().err


@pytest.mark.parametrize("rows", ["training", "recorded"])
@pytest.mark.parametrize("seed", [800_000, 800_099, 810_000, 820_099])
def test_an_episode_of_a_test_scene_is_refused(
    log: Path, record: EpisodeRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: Any, seed: int
) -> None:
    info = dataclasses.replace(record.info, seed=seed)
    monkeypatch.setattr(module, "read_log", lambda path: dataclasses.replace(record, info=info))
    with pytest.raises(DatasetError, match=rf"{log}: seed {seed} of {TASK} .*--split rollouts"):
        export(ExportOptions(files=(log,), out=tmp_path / "out", rows=rows, progress=False))


@pytest.mark.parametrize("change", [{"suite": "openpi"}, {"task": "WipeTheTable"}])
def test_the_same_number_elsewhere_is_another_scene(
    log: Path, record: EpisodeRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, str]
) -> None:
    info = dataclasses.replace(record.info, seed=800_000, **change)
    monkeypatch.setattr(module, "read_log", lambda path: dataclasses.replace(record, info=info))
    assert export(ExportOptions(files=(log,), out=tmp_path / "out", progress=False)) == (1, [])
