"""Pairs are collected as any set is: killed or not, by however many workers, with the same bytes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import numpy as np
import pytest

from dual_system.data import kitchen
from dual_system.data.collect import MachineOptions, collect
from dual_system.data.dataset import Dataset
from dual_system.data.episode import DEMO_CAMERA, Package, unpack
from dual_system.data.kitchen import KitchenOptions, PairJob, record, work_out
from dual_system.data.paired import SPLITS_PATH
from dual_system.tasks.kitchen.environment import KitchenEnvironment
from dual_system.tasks.kitchen.goals import GOAL_SETS, SHOWN_ALONE
from dual_system.tasks.kitchen.layout import ACTION_NAMES, STATE_NAMES
from dual_system.tasks.task import TaskError
from dual_system.training.data import TrainingSet

pytestmark = [pytest.mark.sim, pytest.mark.slow]

PX = 64


def options(out: Path, **changes: object) -> KitchenOptions:
    given = {"tasks": ("CloseDrawer",), "episodes": 1, "image_px": PX, "invocation_hz": 4}
    return KitchenOptions(out=out, **(given | changes))  # type: ignore[arg-type]


worked_out = cache(work_out)


class Here:
    """Works jobs out in this process: of a task in ``anew`` once more, others once for this file.

    Dies before the ``dies_at``-th.
    """

    def __init__(self, dies_at: int | None = None, anew: Sequence[str] = ()) -> None:
        self._dies_at, self._anew = dies_at, anew

    def run(self, jobs: Sequence[PairJob]) -> Iterator[tuple[PairJob, Package]]:
        for place, job in enumerate(jobs):
            if place == self._dies_at:
                raise KeyboardInterrupt
            yield job, work_out(job) if job.task in self._anew else worked_out(job)


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pair each of a held-out task and of a seen one."""
    out = tmp_path_factory.mktemp("pairs") / "set"
    collect(options(out, tasks=("CloseDrawer", "OpenDrawer")), Here())
    return out


def test_a_pair_holds_both_bodies_from_one_start(collected: Path) -> None:
    dataset = Dataset(collected)
    assert (dataset.state_dim, dataset.action_dim) == (len(STATE_NAMES), len(ACTION_NAMES))
    for entry in dataset.episodes:
        rows, start = dataset.rows(entry.index), entry.num_demonstration_rows
        assert start > 20
        assert entry.is_success
        assert rows.is_demonstration[:start].all()
        rendered = np.flatnonzero(rows.is_rendered[:start]).tolist()
        assert rendered == sorted({*range(0, start, 20), start - 1})
        np.testing.assert_array_equal(np.flatnonzero(rows.is_rendered[start:]) % 5, 0)
        assert np.abs(rows.action[start:]).max() <= 1
        assert set(rows.grounded_subgoal[start:]) == {entry.instruction}
        first, last = (views[0] for views in dataset.views(entry, [0, start - 1]))
        assert np.abs(first.astype(int) - last).mean() > 0.5  # the body moved
        with KitchenEnvironment(entry.task, render=False) as environment:
            begun = environment.reset(entry.seed)
            for row in range(start, entry.num_rows):  # what is stored, played again, is the same and reaches the goal
                np.testing.assert_array_equal(rows.state[row], begun.state)
                begun = environment.step(rows.action[row], look=False)
            assert begun.status.value == "success"


def test_a_killed_collection_goes_on_to_the_same_bytes(collected: Path, tmp_path: Path) -> None:
    again = options(tmp_path / "set", tasks=("CloseDrawer", "OpenDrawer"))
    with pytest.raises(KeyboardInterrupt):
        collect(again, Here(dies_at=1))
    collect(again, Here(anew=["OpenDrawer"]))
    files = [path.relative_to(collected) for path in sorted(collected.rglob("*")) if path.is_file()]
    assert len(files) > 5
    for name in files:
        assert (collected / name).read_bytes() == (tmp_path / "set" / name).read_bytes(), name


def test_the_command_writes_the_splits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[MachineOptions] = []

    def here(machine: MachineOptions, work_out: Callable[[PairJob], Package]) -> Here:
        ForkingPickler.dumps((work_out, options(tmp_path).jobs()))  # as a worker's process would get them
        asked.append(machine)
        return Here()

    monkeypatch.setattr(kitchen, "workers_on", here)
    arguments = ["--out", str(tmp_path), "--tasks", "CloseDrawer", "--episodes", "1", "--image-px", str(PX)]
    assert kitchen.main([*arguments, "--invocation-hz", "4", "--workers", "1", "--no-progress"]) == 0
    assert [machine.workers for machine in asked] == [1]
    splits = json.loads((tmp_path / SPLITS_PATH).read_text())
    assert splits["category_balanced"]["unseen"] == {"tasks": ["CloseDrawer"], "episodes": [0]}
    assert splits["precision_sensitive"]["seen"] == {"tasks": ["CloseDrawer"], "episodes": [0]}


def test_training_reads_pairs(collected: Path) -> None:
    data = TrainingSet(collected)
    assert data.robot.demo_cameras == (DEMO_CAMERA,)
    sampling = data.demo_sampling()
    assert sampling is not None
    assert (sampling.hz, sampling.to_its_end, sampling.num_views) == (1, True, 1)
    assert data.statistics(16, "native").state.num_dims == 53


def test_a_goal_set_s_instruction_does_not_tell_the_goal() -> None:
    name = next(iter(GOAL_SETS))
    job = PairJob(task=name, slot=0, image_px=PX, demonstration_hz=1, invocation_hz=1)
    with KitchenEnvironment(name, image_px=PX) as environment:
        episode = unpack(record(environment, job, job.seed(0)))
        words = environment.scene.instruction
        assert environment.instruction == SHOWN_ALONE
    assert episode.about.instruction == SHOWN_ALONE
    assert set(episode.rows.grounded_subgoal[-3:]) == {words}
    assert words != SHOWN_ALONE


def test_what_is_no_task_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TaskError, match="unknown kitchen task 'PickHighlight'; expected PnP"):
        options(tmp_path, tasks=("PickHighlight",)).task_names()
