"""A head that corrects rows at 20 Hz: none changes nothing, one is logged, and `pp-check` derives what it did."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clock.check import disagreements
from clock.check import main as check
from clock.residual import Due, ResidualHead, check_head, corrected, load_head
from clock.residual_mlp import ResidualMlp
from clock.service import ServiceConfig
from protocol import messages as m
from protocol.mcap_log import read_log
from protocol.topics import EVENT, TICK

LIMIT = np.full(7, 0.05, np.float32)
LAST = np.arange(8) == 7  # the gripper
SMALL = LIMIT[:3]  # of the arm whose episodes are played here


@dataclass(frozen=True)
class Nudge:
    """Adds a constant to every number, the gripper included."""

    by: float
    digest: str = "nudge"

    def correction(self, due: Due) -> m.Floats:
        return np.full(len(due.row_A), self.by, np.float32)


def due_at(rng: np.random.Generator, *, num_joints: int = 7) -> Due:
    row_A, state = (rng.uniform(-1, 1, num_joints + 1).astype(np.float32) for _ in range(2))
    return Due(row_A=row_A, state=state, row=3, age_ns=300_000_000)


def test_without_a_head_it_is_the_very_row() -> None:
    due = due_at(np.random.default_rng(0))
    assert corrected(None, due, LAST) is due.row_A


def test_the_gripper_is_not_corrected_nor_the_row_touched() -> None:
    due = due_at(np.random.default_rng(0))
    before = due.row_A.copy()
    row = corrected(Nudge(0.25), due, LAST)
    np.testing.assert_array_equal(row[:-1], before[:-1] + np.float32(0.25))
    assert row[-1] == before[-1]
    np.testing.assert_array_equal(due.row_A, before)


@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0, 100))
def test_no_correction_exceeds_its_limit(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    head = ResidualMlp.untrained(limit_rad=LIMIT, num_units=8)
    wild = ResidualMlp(
        inner=head.inner, outer=(scale * rng.standard_normal(head.outer.shape)).astype(np.float32), limit_rad=LIMIT
    )
    correction = wild.correction(due_at(rng))
    assert (np.abs(correction[:-1]) <= LIMIT).all()
    assert correction[-1] == 0


def test_an_untrained_head_changes_no_bit() -> None:
    due = due_at(np.random.default_rng(0))
    np.testing.assert_array_equal(corrected(ResidualMlp.untrained(limit_rad=LIMIT), due, LAST), due.row_A)


def test_a_fitted_head_learns_what_follows_from_its_inputs() -> None:
    """An arm that lags: the right correction is a part of the distance still to go. Half the ticks are held out."""
    rng = np.random.default_rng(0)
    seen = []
    for tick in range(600):
        state = rng.uniform(-1, 1, 8).astype(np.float32)
        row = np.append(state[:7] + rng.uniform(-0.1, 0.1, 7), 1.0).astype(np.float32)
        seen.append(Due(row_A=row, state=state, row=tick % 20, age_ns=0))
    wanted = np.stack([0.3 * (due.row_A[:7] - due.state[:7]) for due in seen])
    head = ResidualMlp.untrained(limit_rad=LIMIT).fitted(seen[:300], wanted[:300])
    found = np.stack([head.correction(due)[:7] for due in seen[300:]])
    assert np.abs(found - wanted[300:]).mean() < 0.25 * np.abs(wanted[300:]).mean()


def test_a_head_survives_its_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    head = ResidualMlp.untrained(limit_rad=LIMIT).fitted(
        [due_at(rng) for _ in range(9)], rng.uniform(-0.04, 0.04, (9, 7))
    )
    head.save(tmp_path / "head.npz")
    loaded = load_head(tmp_path / "head.npz")
    assert loaded.digest == head.digest != ResidualMlp.untrained(limit_rad=LIMIT).digest
    due = due_at(rng)
    np.testing.assert_array_equal(loaded.correction(due), head.correction(due))


def test_a_head_that_unpacks_without_end_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clock.residual_mlp.MAX_FILE_BYTES", 10_000)
    np.savez_compressed(tmp_path / "head.npz", inner=np.zeros(10_000))
    with pytest.raises(ValueError, match=r"its arrays have 80\d+ bytes, more than"):
        load_head(tmp_path / "head.npz")


def test_files_and_loaders_that_are_none_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", inner=np.zeros(3))
    (tmp_path / "text.npz").write_text("not a head")
    for name in ("other.npz", "text.npz"):
        with pytest.raises(ValueError, match=f"{name} is no residual head"):
            load_head(tmp_path / name)
    with pytest.raises(OSError, match="nowhere"):
        load_head(tmp_path / "nowhere.npz")
    for loader in ("clock.residual_mlp:nobody", "no.such.module:load", "clock.residual_mlp", ""):
        with pytest.raises(ValueError, match="no residual loader"):
            load_head(tmp_path, loader)


def test_a_loader_is_found_by_its_dotted_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    module = ModuleType("somebodys_heads")
    module.make = lambda path: Nudge(0.1, digest=path.name)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "somebodys_heads", module)
    assert load_head(tmp_path / "x", "somebodys_heads:make").digest == "x"


def test_arrays_that_do_not_fit_are_refused() -> None:
    head = ResidualMlp.untrained(limit_rad=LIMIT, num_units=8)
    with pytest.raises(ValueError, match="expected arrays of"):
        ResidualMlp(inner=head.inner, outer=head.outer[:-1], limit_rad=LIMIT)
    with pytest.raises(ValueError, match="finite"):
        ResidualMlp(inner=head.inner * np.inf, outer=head.outer, limit_rad=LIMIT)


HEADS_OF_OTHERS: dict[str, tuple[Any, str]] = {
    "another arm": (ResidualMlp.untrained(limit_rad=LIMIT[:6]), "a row of 7"),
    "NaN": (Nudge(np.nan), "finite numbers"),
}


@pytest.mark.parametrize(("head", "message"), HEADS_OF_OTHERS.values(), ids=HEADS_OF_OTHERS.keys())
def test_a_head_for_another_robot_is_refused(
    head: ResidualHead, message: str, robot_with: Callable[..., m.Robot]
) -> None:
    low = np.full(8, -1, np.float32)
    robot = robot_with(command_low=low, command_high=-low, max_step=-low, initial_command=0 * low, num_proprio=8)
    with pytest.raises(ValueError, match=message):
        check_head(head, robot)
    check_head(ResidualMlp.untrained(limit_rad=LIMIT), robot)


# -- in an episode


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_an_untrained_head_commands_the_same_bits(mode: str, timing: Any, request: pytest.FixtureRequest) -> None:
    play = request.getfixturevalue(mode)
    head = ResidualMlp.untrained(limit_rad=SMALL)
    plain, corrected_ = (play(timing(), 50, seed=5, residual=residual) for residual in (None, head))
    commands = [
        [message.values for message, _ in episode.said if isinstance(message, m.Action)]
        for episode in (plain, corrected_)
    ]
    assert len(commands[0]) > 20
    np.testing.assert_array_equal(commands[0], commands[1])


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_pp_check_derives_what_a_head_did_and_nothing_without_it(
    mode: str, timing: Any, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    play, rng = request.getfixturevalue(mode), np.random.default_rng(3)
    wanted = rng.uniform(-0.04, 0.04, (40, 3))
    head = ResidualMlp.untrained(limit_rad=SMALL).fitted([due_at(rng, num_joints=3) for _ in range(40)], wanted)
    record = read_log(play(timing(), 50, seed=5, residual=head).save(tmp_path / "episode.mcap"))
    assert next(disagreements(record, head), None) is None
    for other in (None, ResidualMlp.untrained(limit_rad=SMALL), Nudge(0.01)):
        found = next(disagreements(record, other))
        assert (found.field, found.found) == ("residual_head", head.digest)
    plain = read_log(play(timing(), 50, seed=5).save(tmp_path / "plain.mcap"))
    assert next(disagreements(plain, head)).field == "residual_head"
    assert any((a.values != b.values).any() for a, b in zip(plain.actions, record.actions, strict=False))


def test_pp_check_takes_the_head_from_its_file(
    timing: Any, lockstep: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    head = ResidualMlp.untrained(limit_rad=SMALL)
    head.save(tmp_path / "head.npz")
    log = str(lockstep(timing(), 20, seed=1, residual=head).save(tmp_path / "episode.mcap"))
    assert check([log]) == 1
    assert "residual_head: expected none (--residual-head)" in capsys.readouterr().out
    assert check([log, "--residual-head", str(tmp_path / "head.npz")]) == 0
    assert check([log, "--residual-head", str(tmp_path / "nowhere.npz")]) == 2


def test_the_clock_service_tells_of_its_head_and_corrects_with_it(
    new_rig: Callable[..., Any], episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> None:
    commands = []
    for head in (None, Nudge(0.01)):
        rig = new_rig(ServiceConfig(watches=False, residual=head))
        take = rig.listen(TICK, EVENT)
        rig.run(episode_info(paper), 30)
        take()
        digests = [event.attributes["digest"] for event in rig.said[m.Event] if event.name == "residual_head"]
        assert digests == ([] if head is None else ["nudge"])
        commands.append(np.stack([tick.raw_row for tick in rig.said[m.Tick]]))
    first_chunk = slice(20)  # the next one is about a world that was moved otherwise
    plain, nudged = (rows[first_chunk] for rows in commands)
    np.testing.assert_array_equal(nudged[:, -1], plain[:, -1])
    np.testing.assert_array_equal(nudged[:, :-1], plain[:, :-1] + np.float32(0.01))


def test_the_clock_service_opens_no_episode_with_a_head_for_another_robot(
    new_rig: Callable[..., Any], episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> None:
    rig = new_rig(ServiceConfig(watches=False, residual=Nudge(np.nan)))
    assert "the residual head nudge does not fit" in rig.open(episode_info(paper)).error
