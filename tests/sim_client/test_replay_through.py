"""A log through another POUNCE: the same one gives the same rows, another one is told where it first differs."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pounce_server import in_process
from protocol import messages as m
from protocol.mcap_log import read_log
from sim_client.recorder import Recorder
from sim_client.replay_through import Compared, main, summary

Info = Callable[..., m.EpisodeInfo]


@pytest.fixture
def log(rig: Any, episode_info: Info, paper: m.Schedule, tmp_path: Path) -> Path:
    info, path = episode_info(paper), tmp_path / "log.mcap"
    recorder = Recorder(rig.links["sim"], "exact")
    recorder.begin(info, path)
    rig.meanwhile = recorder.step
    rig.run(info, 60)
    recorder.end(m.EpisodeResult(status=m.TaskStatus.ONGOING, is_success=False, reason="", num_ticks=60))
    return path


@pytest.fixture
def through(log: Path, fake_pounce: Any, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> Callable[..., Any]:
    """Runs the command with this engine; returns its exit code and what it printed."""
    monkeypatch.setattr(in_process, "build_engine", lambda options: fake_pounce)

    def run(*arguments: str) -> tuple[int, dict[str, Any]]:
        code = main([str(log), "--pounce", "somewhere", "--json", *arguments])
        out = capsys.readouterr()
        return code, json.loads(out.out) if code < 2 else {"error": out.err}

    return run


def test_the_same_pounce_gives_the_same_rows_bit_for_bit(through: Callable[..., Any], log: Path) -> None:
    code, found = through()
    assert (code, found["max"], found["first"], found["pixels"]) == (0, 0.0, None, "exact")
    assert found["chunks"] == len(read_log(log).chunks) >= 3
    assert found["rows"] == 20 * found["chunks"]


def test_another_pounce_is_told_where_it_first_differs(
    through: Callable[..., Any], fake_pounce: Any, tmp_path: Path
) -> None:
    plain = fake_pounce.invoke

    def bent(request: Any, progress: Any = None) -> m.Floats:
        rows_NA = plain(request).copy()
        if len(fake_pounce.requests) == 2:
            rows_NA[7, 1] += 0.25
        return rows_NA

    fake_pounce.invoke = bent
    fake_pounce.spec = replace(fake_pounce.spec, model_hash="another")
    code, found = through("--rows", str(tmp_path / "rows.csv"))
    assert code == 1
    assert (found["logged"], found["through"]) == ("fake-pounce", "another")
    assert (found["max"], found["rows_beyond"]) == (pytest.approx(0.25), 1)
    assert found["max_per_dimension"] == [0.0, pytest.approx(0.25), 0.0]
    first = found["first"]
    assert (first["invocation"], first["row"], first["dimension"]) == (1, 7, 1)
    assert first["came"] - first["logged"] == pytest.approx(0.25)
    with (tmp_path / "rows.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == found["rows"]
    differing = [row for row in rows if row["logged_1"] != row["came_1"]]
    assert [(row["invocation"], row["row"], int(row["tick"])) for row in differing] == [("1", "7", first["tick"])]
    code, _ = through("--tolerance", "0.3")
    assert code == 0


def test_one_that_refuses_some_is_compared_by_the_others(through: Callable[..., Any], fake_pounce: Any) -> None:
    plain = fake_pounce.invoke

    def picky(request: Any, progress: Any = None) -> m.Floats:
        rows_NA = plain(request)
        if len(fake_pounce.requests) == 1:
            raise ValueError("not this one")
        return rows_NA  # type: ignore[no-any-return]

    fake_pounce.invoke = picky
    code, found = through()
    assert (code, found["not_answered"]) == (0, 1)


def test_one_for_another_robot_is_refused(through: Callable[..., Any], fake_pounce: Any) -> None:
    fake_pounce.spec = replace(fake_pounce.spec, proprio_dim=5)
    code, found = through()
    assert code == 2
    assert "POUNCE reads 5 joint values, the robot has 3" in found["error"]


def test_a_log_without_a_shadow_needs_a_checkpoint(log: Path, capsys: Any) -> None:
    assert main([str(log)]) == 2
    assert "no shadow of POUNCE answered in it; name a checkpoint with --pounce" in capsys.readouterr().err


@given(
    st.lists(st.lists(st.floats(-2, 2, width=32), min_size=6, max_size=6), min_size=1, max_size=6),
    st.sampled_from([0.0, 0.5]),
)
def test_what_is_said_of_differences_is_so(numbers: list[list[float]], tolerance: float) -> None:
    others = [np.array(each, np.float32).reshape(2, 3) for each in numbers]
    chunks = [
        m.ActionChunk(
            invocation=index, t_row0=2 * index, horizon=2, action_dim=3, dt_ns=1, rows=np.zeros(6, np.float32),
            source_ns=0, ref_query=None, age_ns=0,
        )
        for index in range(len(others))
    ]  # fmt: skip
    compared = Compared(chunks=chunks, others=others, refused={}, model_hash="", pixels="")
    found: Any = summary(compared, tolerance)
    largest = np.abs(np.stack(others)).reshape(-1, 3)
    assert found["max"] == largest.max()
    assert found["max_per_dimension"] == largest.max(axis=0).tolist()
    assert found["p99"] <= found["max"]
    assert found["rows_beyond"] == (largest > tolerance).any(axis=1).sum()
    beyond = np.argwhere(largest > tolerance)
    if found["first"] is None:
        assert not len(beyond)
    else:
        assert [found["first"]["tick"], found["first"]["dimension"]] == beyond[0].tolist()
