"""A collection that was killed anywhere and resumed is the one that was not, byte for byte; and what it refuses."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dual_system.data import collect as module
from dual_system.data.card import card
from dual_system.data.collect import (
    COLLECTING,
    COLLECTION_PATH,
    CollectOptions,
    EpisodesOptions,
    MachineOptions,
    PicturesOptions,
    collect,
    disk_needed,
)
from dual_system.data.dart import DART
from dual_system.data.dataset import Dataset
from dual_system.data.episode import Package
from dual_system.data.errors import DatasetError
from dual_system.data.jobs import Job
from dual_system.data.rollout import UNSOLVED
from dual_system.data.shove import SHOVES
from dual_system.data.store import Store

TASKS, EPISODES = ("PickHighlight", "VideoUnmask"), 3  # names only: nothing is simulated here
WorkOut = Callable[[Job], Package]


class Killed(BaseException):
    """The process is gone."""


class InOrder:
    """Works jobs out in a given order of its own, and is killed when it has done so many."""

    def __init__(self, work_out: WorkOut, order: Sequence[int] = (), dies_after: int | None = None) -> None:
        self.done: list[str] = []
        self._work_out, self._order, self._dies_after = work_out, order, dies_after

    def run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, Package]]:
        order = [index for index in self._order if index < len(jobs)] or range(len(jobs))
        for index in order:
            if len(self.done) == self._dies_after:
                raise Killed
            self.done.append(jobs[index].key)
            yield jobs[index], self._work_out(jobs[index])


def options(out: Path, **changes: Any) -> CollectOptions:
    """Options by their names on the command line, whichever group they are in."""
    values: dict[str, Any] = {"out": out, "tasks": TASKS, "episodes": EPISODES, "progress": False} | changes
    groups = {}
    for name, kind in {"pictures": PicturesOptions, "content": EpisodesOptions, "machine": MachineOptions}.items():
        own = {field.name for field in dataclasses.fields(kind)} & values.keys()
        groups[name] = kind(**{each: values.pop(each) for each in own})
    return CollectOptions(**values, **groups)


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, pretend: WorkOut) -> dict[str, bytes]:
    """The files of a collection that nobody disturbed."""
    out = tmp_path_factory.mktemp("whole")
    collect(options(out), InOrder(pretend))
    return files(out)


@given(
    kills=st.lists(st.integers(0, len(TASKS) * EPISODES - 1), max_size=3),
    order=st.permutations(range(len(TASKS) * EPISODES)),
    steps=st.integers(0, 40),
)
@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_killed_and_resumed_is_as_if_nothing_had_been(
    tmp_path_factory: pytest.TempPathFactory,
    pretend: WorkOut,
    whole: dict[str, bytes],
    kills: list[int],
    order: list[int],
    steps: int,
) -> None:
    """Killed between episodes, in whatever order they come, and then within a commit or the final join."""
    out = tmp_path_factory.mktemp("killed")
    done: list[str] = []
    for dies_after in kills:
        workers = InOrder(pretend, order, dies_after)
        with contextlib.suppress(Killed):
            collect(options(out), workers)
        done += workers.done
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "rename", _dying(Path.rename, steps))
        workers = InOrder(pretend)
        try:
            collect(options(out), workers)
        except Killed:
            done += workers.done[:-1]  # what was not committed yet is worked out once more
        else:
            done += workers.done
    collect(options(out), InOrder(pretend))
    assert files(out) == whole
    assert len(set(done)) == len(done)


def _dying(rename: Callable[..., Path], steps: int) -> Callable[..., Path]:
    """A rename that is killed the ``steps``-th time, before it has done anything."""
    left = iter(range(steps))

    def dying(self: Path, target: Path) -> Path:
        if next(left, None) is None:
            raise Killed
        return rename(self, target)

    return dying


def test_noise_is_told_and_counted_and_never_mixed_with_none(tmp_path: Path, pretend: WorkOut) -> None:
    def mostly(job: Job) -> Package:
        if job.slot:
            return pretend(job)
        tried = [{"seed": 1, "reason": "fail", "noise_rad": 0.02}, {"seed": 2, "reason": "fail", "noise_rad": 0.0}]
        return {UNSOLVED: json.dumps(tried).encode()}

    noisy = options(tmp_path, noise="dart")
    report = collect(noisy, InOrder(mostly))
    assert (report.num_rejected, report.num_rejected_noisy) == (4, 2)
    assert collect(noisy, InOrder(mostly)) == report  # read from the folder
    told = json.loads((tmp_path / COLLECTION_PATH).read_text())
    assert told["settings"]["noise"] == DART.settings()
    assert [each.noise_rad for each in Dataset(tmp_path).episodes] == [0.01, 0.0] * 2
    assert "2 of 4 have none" in card(Dataset(tmp_path))
    with pytest.raises(DatasetError, match="another --out"):
        collect(options(tmp_path, noise="none"), InOrder(pretend))


def test_difficulties_are_recorded_and_never_mixed(tmp_path: Path, pretend: WorkOut) -> None:
    ours = options(tmp_path, difficulties=("hard", "easy"))
    collect(ours, InOrder(pretend))
    told = json.loads((tmp_path / COLLECTION_PATH).read_text())["settings"]
    assert told["difficulties"] == ["hard", "easy"]
    assert not {"texts", "shoves"} & set(told)
    with pytest.raises(DatasetError, match="another --out"):
        collect(options(tmp_path, difficulties=("easy", "hard")), InOrder(pretend))


def test_shoves_and_texts_that_follow_are_told_and_never_mixed(tmp_path: Path, pretend: WorkOut) -> None:
    ours = options(tmp_path, texts="follow", shove_share=0.7)
    collect(ours, InOrder(pretend))
    told = json.loads((tmp_path / COLLECTION_PATH).read_text())["settings"]
    assert told["texts"] == "follow"
    assert told["shoves"] == SHOVES.settings(0.7)
    assert "70 %" in card(Dataset(tmp_path))
    for other in ({"texts": "follow"}, {}, {"texts": "follow", "shove_share": 0.6}):
        with pytest.raises(DatasetError, match="another --out"):
            collect(options(tmp_path, **other), InOrder(pretend))


def test_without_noise_nothing_is_said_of_it(whole: dict[str, bytes]) -> None:
    assert "noise" not in whole[COLLECTION_PATH].decode()


def test_a_finished_collection_is_left_alone(tmp_path: Path, pretend: WorkOut) -> None:
    first = collect(options(tmp_path), InOrder(pretend))
    idle = InOrder(pretend)
    assert collect(options(tmp_path), idle) == first
    assert idle.done == []
    assert not (tmp_path / COLLECTING).exists()


def test_kept_episodes_can_be_added_to(tmp_path: Path, pretend: WorkOut, whole: dict[str, bytes]) -> None:
    collect(options(tmp_path, episodes=2, keep_episodes=True), InOrder(pretend))
    more = InOrder(pretend)
    collect(options(tmp_path), more)
    assert more.done == [f"{task}/000002" for task in TASKS]
    assert files(tmp_path) == whole


@pytest.mark.parametrize(("keep_episodes", "changes"), [(True, {"image_px": 64}), (False, {"episodes": 9})])
def test_a_folder_that_was_begun_otherwise_is_refused(
    tmp_path: Path, pretend: WorkOut, keep_episodes: bool, changes: dict[str, Any]
) -> None:
    collect(options(tmp_path, keep_episodes=keep_episodes), InOrder(pretend))
    with pytest.raises(DatasetError, match="another --out"):
        collect(options(tmp_path, **changes), InOrder(pretend))


def test_two_collectors_do_not_share_a_folder(tmp_path: Path, pretend: WorkOut) -> None:
    with Store(tmp_path / COLLECTING), pytest.raises(DatasetError, match="another process"):
        collect(options(tmp_path), InOrder(pretend))


def test_episodes_that_nobody_could_solve_are_listed_and_not_tried_again(tmp_path: Path, pretend: WorkOut) -> None:
    def mostly(job: Job) -> Package:
        tried = [{"seed": job.seed(0), "reason": "fail"}]
        return {UNSOLVED: json.dumps(tried).encode()} if job.slot == 1 else pretend(job)

    report = collect(options(tmp_path, keep_episodes=True), InOrder(mostly))
    assert report.unsolved == tuple(f"{task}/000001" for task in TASKS)
    assert (report.num_episodes, report.num_rejected) == (4, 2)
    assert len(Dataset(tmp_path).episodes) == 4
    again = InOrder(pretend)
    collect(options(tmp_path, episodes=4), again)
    assert again.done == [f"{task}/000003" for task in TASKS]


def test_a_small_disk_is_refused_with_numbers_before_anything_starts(
    tmp_path: Path, pretend: WorkOut, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1_000_000))
    idle = InOrder(pretend)
    with pytest.raises(DatasetError, match=r"25\.2 GB are still needed and 0\.0 GB are free"):
        collect(options(tmp_path, episodes=3000), idle)
    assert idle.done == []


def test_a_disk_that_fills_up_stops_the_work_and_keeps_it(
    tmp_path: Path, pretend: WorkOut, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    commit = module.Store.commit
    with monkeypatch.context() as patch:

        def full(store: Store, key: str, package: Package) -> None:
            if key.endswith("2"):
                raise OSError(28, "No space left on device")
            commit(store, key, package)

        patch.setattr(module.Store, "commit", full)
        with pytest.raises(DatasetError, match="No space left"):
            collect(options(tmp_path), InOrder(pretend))
    rest = InOrder(pretend)
    collect(options(tmp_path), rest)
    assert len(rest.done) == 4
    assert files(tmp_path) == whole


def test_the_estimate_is_what_was_measured_as_soon_as_something_was() -> None:
    assert disk_needed(10, [100] * 5, 256) == 10 * 100 * 2 + 500
    assert disk_needed(10, [], 128) == disk_needed(10, [], 256) // 2


@pytest.mark.parametrize(
    "changes",
    [
        {"image_px": 65},
        {"episodes": 0},
        {"workers": 0},
        {"texts": "follow", "shove_share": 1.1},
        {"shove_share": 0.5},
    ],
)
def test_options_that_make_no_sense_are_refused(tmp_path: Path, changes: dict[str, Any]) -> None:
    with pytest.raises(DatasetError):
        options(tmp_path, **changes)
