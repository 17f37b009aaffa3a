"""Log lines as JSON, and log files that are rotated and limited."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest

from protocol import logs
from protocol.errors import TransportError
from protocol.logs import KEPT_FILES, JsonFormatter, handler_of
from protocol.options import OperationsOptions


def fact(template: str, *args: object, **record: object) -> dict[str, object]:
    values = {"name": "clock", "levelname": "INFO", "msg": template, "args": args, "created": 0.25} | record
    line = JsonFormatter().format(logging.makeLogRecord(values))
    assert "\n" not in line
    return dict(json.loads(line))


def test_a_fact_has_its_values_by_their_keys_and_types() -> None:
    assert fact("ready infer_p50_ms=%.1f robot=%s", 78.12, "r0") == {
        "at": "1970-01-01T00:00:00.250+00:00",
        "level": "INFO",
        "logger": "clock",
        "message": "ready infer_p50_ms=78.1 robot=r0",
        "infer_p50_ms": 78.12,
        "robot": "r0",
    }


@pytest.mark.parametrize(
    ("template", "args", "found"),
    [
        ("dropped source=%s reason=%s detail=%r (counted)", ("sim", "stranger", "a b"), {"detail": "a b"}),
        ("at %d%% of key=%s", (5, "x"), {"key": "x"}),
        ("%s", ("no key=value of ours",), {}),
        ("nothing=%", (), {}),
        ("path=%s", (Path("a"),), {"path": "a"}),
    ],
)
def test_values_without_a_key_are_in_the_message_only(
    template: str, args: tuple[object, ...], found: dict[str, object]
) -> None:
    extra = {key: value for key, value in fact(template, *args).items() if key not in fact("")}
    assert extra.items() >= found.items()
    assert len(extra) == (3 if len(args) == 3 else len(found))


def test_a_traceback_stays_in_its_line() -> None:
    try:
        raise RuntimeError("first\nsecond")
    except RuntimeError as error:
        told = fact("failed", exc_info=(type(error), error, error.__traceback__))
    assert "RuntimeError: first\nsecond" in str(told["traceback"])


def test_files_are_rotated_and_never_more_than_their_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs, "MB", 200)
    handler = handler_of(OperationsOptions(log_json=True, log_file=tmp_path / "clock.log", log_mb=10))
    for number in range(200):
        handler.emit(logging.makeLogRecord({"msg": "tick=%d", "args": (number,)}))
    handler.close()
    files = sorted(tmp_path.iterdir())
    assert [file.name for file in files] == ["clock.log", *(f"clock.log.{n + 1}" for n in range(KEPT_FILES))]
    assert sum(file.stat().st_size for file in files) <= 10 * 200
    assert json.loads(files[0].read_text().splitlines()[-1])["tick"] == 199


@pytest.mark.parametrize(
    ("file", "limit_mb", "says"),
    [
        ("nowhere/clock.log", 5, r"--log-file .*: No such file .*may write"),
        ("clock.log", 4, r"--log-mb 4: .* at least 5"),
    ],
)
def test_a_log_file_that_cannot_be_is_a_sentence(file: str, limit_mb: int, says: str, tmp_path: Path) -> None:
    with pytest.raises(TransportError, match=says):
        handler_of(OperationsOptions(log_file=tmp_path / file, log_mb=limit_mb))
