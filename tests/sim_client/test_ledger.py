"""The ledger: finished episodes are there once and whole, whatever a kill has left of the last line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_client.ledger import EPISODES, Ledger, LedgerError

SETTINGS = {"delay_ms": 300}
LINES = {f"StopCube/0/{seed}": {"seed": seed, "success": bool(seed % 2)} for seed in range(4)}


def lines_of(out: Path) -> dict[str, dict[str, Any]]:
    with Ledger(out, SETTINGS) as ledger:
        return dict(ledger.lines)


@given(st.data())
def test_a_torn_line_is_forgotten_and_everything_before_it_kept(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    out = tmp_path_factory.mktemp("ledger")
    with Ledger(out, SETTINGS) as ledger:
        for key, line in LINES.items():
            ledger.commit(key, line)
    whole = (out / EPISODES).read_bytes()
    cut = data.draw(st.integers(0, len(whole)))
    (out / EPISODES).write_bytes(whole[:cut])
    kept = whole[:cut].count(b"\n")
    with Ledger(out, SETTINGS) as ledger:
        assert ledger.lines == dict(list(LINES.items())[:kept])
        for key, line in LINES.items():
            ledger.commit(key, line)
    assert (out / EPISODES).read_bytes() == whole


def test_a_key_is_committed_once(tmp_path: Path) -> None:
    with Ledger(tmp_path, SETTINGS) as ledger:
        ledger.commit("a", {"success": True})
        ledger.commit("a", {"success": False})
    assert lines_of(tmp_path) == {"a": {"success": True}}


def test_two_cannot_write_one_folder(tmp_path: Path) -> None:
    with Ledger(tmp_path, SETTINGS), pytest.raises(LedgerError, match="another pp-eval"):
        Ledger(tmp_path, SETTINGS)
    assert lines_of(tmp_path) == {}


def test_another_condition_is_refused_by_the_option_s_name(tmp_path: Path) -> None:
    assert lines_of(tmp_path) == {}
    with pytest.raises(LedgerError, match="delay_ms = 300, and this is 500"):
        Ledger(tmp_path, {"delay_ms": 500})
    assert lines_of(tmp_path) == {}


def test_a_damaged_line_is_named(tmp_path: Path) -> None:
    (tmp_path / EPISODES).write_bytes(b'{"key": "a", "episode": {}}\nnonsense\n')
    with pytest.raises(LedgerError, match=r"line 2"):
        Ledger(tmp_path, SETTINGS)
