"""Finished episodes of an evaluation: one line each in a file, complete and stored once, even if processes are killed.

A line is appended and synced to disk before the next; one that a kill has truncated has no end of line and is removed
by the next run. A lock keeps two evaluations out of one folder.
"""

from __future__ import annotations

import fcntl
import json
import os
from pathlib import Path
from types import TracebackType
from typing import Any

from protocol import files
from protocol.errors import CommandError

SETTINGS, EPISODES = "settings.json", "episodes.jsonl"
_SETTINGS_KIND = "settings file of pp-eval"


class LedgerError(CommandError):
    """The evaluation cannot continue in this folder; the message says what was expected, and the way out."""


class Ledger:
    """Lines by key. A context manager, because of the lock.

    Args:
        settings: what all episodes of one folder have in common.

    Attributes:
        lines: what is finished, by key.

    Raises:
        LedgerError: another process works here, the folder was begun with other settings, or a line is damaged.
    """

    def __init__(self, out: Path, settings: dict[str, Any]) -> None:
        self._path = files.folder(out) / EPISODES
        self._file = self._path.open("a+b")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise LedgerError(f"another pp-eval works in {out}; let it finish, or use another --out") from None
        try:
            _claim(out / SETTINGS, settings)
            self.lines = self._read()
        except BaseException:
            self._file.close()
            raise

    def commit(self, key: str, line: dict[str, Any]) -> None:
        """Writes one line to disk; an existing key is kept."""
        if key in self.lines:
            return
        with files.writing(self._path):
            self._file.write(json.dumps({"key": key, "episode": line}).encode() + b"\n")
            self._file.flush()
            os.fsync(self._file.fileno())
        self.lines[key] = line

    def _read(self) -> dict[str, dict[str, Any]]:
        self._file.seek(0)
        *whole, torn = self._file.read().split(b"\n")
        if torn:
            self._file.truncate(self._file.tell() - len(torn))
        lines: dict[str, dict[str, Any]] = {}
        for number, text in enumerate(whole, 1):
            try:
                entry = json.loads(text)
                lines[entry["key"]] = entry["episode"]
            except (ValueError, KeyError, TypeError) as error:
                raise LedgerError(
                    f"{self._path}, line {number}, is no finished episode ({error!r}); take the line out and start "
                    "again, its episode is then played again"
                ) from error
        return lines

    def __enter__(self) -> Ledger:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


def write_json(path: Path, value: Any) -> None:
    """Writes atomically, so that a reader never gets a partial file. Raises OSError that names ``path``."""
    partial = path.with_suffix(".json.partial")
    with files.writing(path):
        partial.write_text(json.dumps(value, indent=1) + "\n")
        partial.replace(path)


def _claim(path: Path, settings: dict[str, Any]) -> None:
    """Writes down with what settings a folder was begun. Raises LedgerError if they are others now."""
    if not path.exists():
        write_json(path, settings)
        return
    there = files.read_json(path, _SETTINGS_KIND)
    with files.reading(path, _SETTINGS_KIND):
        differing = sorted(name for name in there.keys() | settings.keys() if there.get(name) != settings.get(name))
    if differing:
        name = differing[0]
        raise LedgerError(
            f"{path.parent} was begun with {name} = {there.get(name)!r}, and this is {settings.get(name)!r}"
            f"{' (and others: ' + ', '.join(differing[1:]) + ')' if differing[1:] else ''}; one folder holds one "
            "condition: use the options it was begun with, or another --out"
        )
