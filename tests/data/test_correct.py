"""A recorded episode that the oracle takes over: what was recorded until then, and what should be done from then on."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from clock.sampling import ROBOMME
from dual_system.data import correct as module
from dual_system.data.correct import CorrectOptions, Job, Outcome, correct, main, work_out
from dual_system.data.dataset import Dataset
from dual_system.data.episode import unpack
from dual_system.data.errors import DatasetError
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from dual_system.tasks.environment import Snapshot, make_environment
from dual_system.training.data import TrainingSet
from dual_system.training.example import ExampleConfig, make_example
from protocol.mcap_log import EpisodeRecord, read_log
from sim_client.config import LogOptions

PARTS = 3

pytestmark = pytest.mark.sim


class HereAndNow:
    """Works jobs out in this process, the last one first; some parts in vain."""

    def __init__(self, *in_vain: int, outcomes: Sequence[Outcome] = ()) -> None:
        self._in_vain, self._outcomes = in_vain, outcomes

    def run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, Outcome]]:
        for job in reversed(jobs):
            if job.part in self._in_vain:
                yield job, Outcome(package=None, reason="too late")
            else:
                yield job, self._outcomes[job.part] if self._outcomes else work_out(job)


@pytest.fixture(scope="module")
def log(recorded: Callable[..., Path]) -> Path:
    """Of an episode whose pictures nobody keeps."""
    return recorded("PickXtimes", 2, LogOptions(record_hz=1))  # of one round


@pytest.fixture(scope="module")
def record(log: Path) -> EpisodeRecord:
    return read_log(log)


def options(log: Path, out: Path) -> CorrectOptions:
    return CorrectOptions(files=(log,), out=out, per_episode=PARTS, record_hz=1, image_px=64, workers=1, progress=False)


@pytest.fixture(scope="module")
def outcomes(log: Path) -> list[Outcome]:
    """What each part of the log becomes."""
    return [work_out(Job(path=log, part=part, options=options(log, log.parent))) for part in range(PARTS)]


@pytest.fixture(scope="module")
def corrected(log: Path, outcomes: list[Outcome], tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    out = tmp_path_factory.mktemp("corrected") / "dataset"
    reasons = correct(options(log, out), HereAndNow(outcomes=outcomes))
    assert len(Dataset(out).episodes) + len(reasons) == PARTS
    return Dataset(out)


@pytest.mark.parametrize("part", range(PARTS))
def test_until_then_it_is_the_log_and_then_the_oracle_solves_it(
    outcomes: list[Outcome], record: EpisodeRecord, part: int
) -> None:
    actions = np.stack([tick.action for tick in record.ticks])
    states = np.stack([each.proprio for each in record.observations])
    package = outcomes[part].package
    if package is None:  # the button at the end is begun anew, which nobody should imitate
        assert part == PARTS - 1
        return
    rows, about = unpack(package).rows, unpack(package).about
    same = next(row for row, action in enumerate(rows.action) if not np.array_equal(action, actions[row]))
    num_ticks = len(actions)
    assert int(part / PARTS * num_ticks) <= same <= about.corrected_from + num_ticks / PARTS
    np.testing.assert_array_equal(rows.state[: same + 1], states[: same + 1])
    assert (about.is_success, about.origin, about.difficulty) == (True, "oracle, corrected", "easy")
    assert int(part / PARTS * num_ticks) <= about.corrected_from < len(rows)


def test_episodes_lie_as_the_parts_of_the_log_do(corrected: Dataset) -> None:
    begun = [entry.corrected_from for entry in corrected.episodes]
    assert begun == sorted(set(begun))
    assert len(begun) >= PARTS - 1


def test_only_what_the_oracle_did_is_imitated(corrected: Dataset) -> None:
    form = Ponder.random(dataclasses.replace(tiny_cpu(), image_px=(64, 64), num_layers=4), seed=1).format
    data = TrainingSet(corrected.root, corrected.root)
    assert len(data) == 2 * len(corrected.episodes)
    for number, entry in enumerate(corrected.episodes):
        episode = data[number]
        for seed in range(5):
            config = ExampleConfig(clocks=ROBOMME, max_invocations=8)
            example = make_example(episode, form, config, np.random.default_rng(seed))
            assert example.invocations
            assert all(each.tick >= entry.corrected_from for each in example.invocations)
            assert any(query.tick < entry.corrected_from for query in example.schedule.queries)  # PONDER follows all


def test_it_is_a_function_of_the_log(log: Path, outcomes: list[Outcome], tmp_path: Path) -> None:
    assert work_out(Job(path=log, part=1, options=options(log, tmp_path))) == outcomes[1]


def test_another_scene_is_refused(log: Path, record: EpisodeRecord, monkeypatch: pytest.MonkeyPatch) -> None:
    moved = [dataclasses.replace(each, proprio=each.proprio + 1e-3) for each in record.observations]
    monkeypatch.setattr(module, "read_log", lambda path: dataclasses.replace(record, observations=moved))
    with pytest.raises(DatasetError, match="with those versions"):
        work_out(Job(path=log, part=1, options=options(log, log.parent)))


def test_another_subgoal_is_refused(log: Path, record: EpisodeRecord, monkeypatch: pytest.MonkeyPatch) -> None:
    other = [dataclasses.replace(each, text="pick up the second cube") for each in record.subgoals]
    monkeypatch.setattr(module, "read_log", lambda path: dataclasses.replace(record, subgoals=other))
    with pytest.raises(DatasetError, match=r"the subgoal is .* here and 'pick up the second cube' in the log"):
        work_out(Job(path=log, part=1, options=options(log, log.parent)))


@pytest.mark.parametrize(("subgoal_index", "is_taken"), [(0, True), (1, False)])
def test_after_something_was_dropped_the_text_may_be_that_of_its_grasp(
    log: Path, record: EpisodeRecord, subgoal_index: int, is_taken: bool
) -> None:
    """The policy's log has each subtask's own text; here texts follow what happens."""
    num_ticks = 30
    with make_environment(record.info.task, render=False) as environment:
        first = environment.reset(record.info.seed, record.info.difficulty)
    dropped = dataclasses.replace(
        first,
        state=record.observations[num_ticks].proprio,
        subtask_index=1,
        subgoal_index=subgoal_index,
        simple_subgoal="pick up what was dropped",
    )

    class Replayed:
        def step(self, snapshot: Snapshot, action: np.ndarray) -> Snapshot:
            return dropped

    actions = [tick.action for tick in record.ticks[:num_ticks]]
    with contextlib.nullcontext() if is_taken else pytest.raises(DatasetError, match="the subgoal is 'pick up what"):
        assert module._acted_out(log, record, Replayed(), first, actions) is dropped  # type: ignore[arg-type]


def test_a_log_with_a_gap_is_refused(log: Path, record: EpisodeRecord, monkeypatch: pytest.MonkeyPatch) -> None:
    holed = dataclasses.replace(record, ticks=record.ticks[:7] + record.ticks[8:])
    monkeypatch.setattr(module, "read_log", lambda path: holed)
    with pytest.raises(DatasetError, match="tick 7"):
        work_out(Job(path=log, part=1, options=options(log, log.parent)))


def test_what_is_not_kept_is_counted(
    log: Path,
    outcomes: list[Outcome],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(module, "LocalWorkers", lambda num_workers, work_out: HereAndNow(0, outcomes=outcomes))
    assert main([str(log), "--out", str(tmp_path / "a"), "--per-episode", "2", "--no-progress"]) == module.DONE
    said = capsys.readouterr().out
    assert "1 episodes of 1 logs" in said
    assert "1 not kept: too late" in said


def test_a_log_that_goes_on_for_longer_than_an_episode_may_is_none(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module, "LocalWorkers", lambda num_workers, work_out: HereAndNow())
    arguments = [str(log), "--out", str(tmp_path / "a"), "--max-steps", "60", "--per-episode", "1", "--no-progress"]
    assert main(arguments) == module.REFUSED
    assert "no episode was left to write: the log goes on beyond --max-steps" in capsys.readouterr().err
    assert not (tmp_path / "a" / "meta").exists()


def test_nothing_is_overwritten(log: Path, corrected: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(log), "--out", str(corrected.root), "--no-progress"]) == module.REFUSED
    assert "another --out" in capsys.readouterr().err


@pytest.mark.parametrize("seed", [500_000, 799_999, 800_000, 810_000])
def test_a_scene_that_nothing_is_trained_on_is_refused(
    log: Path, record: EpisodeRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    info = dataclasses.replace(record.info, seed=seed)
    monkeypatch.setattr(module, "read_log", lambda path: dataclasses.replace(record, info=info))
    with pytest.raises(DatasetError, match=rf"{log}: seed {seed} of PickXtimes .*--split rollouts"):
        correct(options(log, tmp_path / "out"), HereAndNow())
