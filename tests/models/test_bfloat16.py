"""Who asks for bfloat16 where it is slow is told so, by every command that takes it; nobody else is told anything."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from dual_system.models import bfloat16
from dual_system.training import train
from ponder_server.__main__ import build_engine as build_ponder
from ponder_server.config import PonderOptions
from pounce_server.__main__ import build_engine as build_pounce
from pounce_server.config import PounceOptions


@pytest.mark.parametrize("is_fast", [False, True])
@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_the_warning_is_for_one_case(dtype: str, device: str, is_fast: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bfloat16, "HAS_FAST_BFLOAT16", is_fast)
    warning = bfloat16.warn_of_slow(dtype, device)
    assert (warning is not None) == ((dtype, device, is_fast) == ("bfloat16", "cpu", False))


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
@pytest.mark.parametrize("system", ["ponder", "pounce"])
def test_servers_say_it_at_start(
    system: str, dtype: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(bfloat16, "HAS_FAST_BFLOAT16", False)
    with caplog.at_level(logging.WARNING):
        if system == "ponder":
            build_ponder(PonderOptions(dtype=dtype))  # type: ignore[arg-type]
        else:
            build_pounce(PounceOptions(dtype=dtype))  # type: ignore[arg-type]
    told = [record for record in caplog.records if "does not multiply it in hardware" in record.message]
    assert len(told) == (dtype == "bfloat16")


def test_the_trainer_says_it_before_it_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bfloat16, "HAS_FAST_BFLOAT16", False)
    arguments = ["--recipe", "tiny", "--data", str(tmp_path), "--out", str(tmp_path / "out"), "--dtype", "bfloat16"]
    assert train.main(arguments) == train.REFUSED
    said = capsys.readouterr().err.splitlines()
    assert "does not multiply it in hardware" in said[0]
    assert len(said) > 1
