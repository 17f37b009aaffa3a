"""Finished episodes before they join a dataset: each is complete or absent, and stored once, whatever is killed.

A package is written aside, synced to disk and renamed to its place; the next process removes what a killed one left
aside. A lock keeps two collectors out of one folder.
"""

from __future__ import annotations

import fcntl
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from dual_system.data.episode import Package
from dual_system.data.errors import DatasetError
from protocol import disk


class Store:
    """Packages by key, in their own folder; a key is ``task/number``. A context manager, because of the lock.

    Raises:
        DatasetError: another process works in this folder.
    """

    def __init__(self, root: Path) -> None:
        self._episodes, self._aside = root / "episodes", root / "aside"
        self._episodes.mkdir(parents=True, exist_ok=True)
        self._lock = (root / "lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            raise DatasetError(
                f"another process collects in {root.parent}; let it finish, or use another --out"
            ) from None
        shutil.rmtree(self._aside, ignore_errors=True)

    def commit(self, key: str, package: Package) -> None:
        """Writes a package to disk atomically; an existing one is kept."""
        place = self._episodes / key
        if place.exists():
            return
        aside = self._aside / key
        aside.mkdir(parents=True)
        for name, content in package.items():
            (aside / name).write_bytes(content)
            disk.sync(aside / name)
        place.parent.mkdir(exist_ok=True)
        aside.rename(place)
        disk.sync(place.parent)

    def read(self, key: str) -> Package:
        """Returns a package that is there."""
        return {path.name: path.read_bytes() for path in sorted((self._episodes / key).iterdir())}

    def num_bytes(self, key: str) -> int:
        """Size of a package that is there."""
        return sum(path.stat().st_size for path in (self._episodes / key).iterdir())

    def keys(self) -> Iterator[str]:
        """Every package that is there."""
        for place in sorted(self._episodes.glob("*/*")):
            yield str(place.relative_to(self._episodes))

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._lock.close()
