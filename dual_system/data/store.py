"""Finished episodes under way to a dataset: each is whole or absent, and there once, whoever is killed when.

A package is written aside, forced to disk and renamed to its place; what a killed process left aside is swept away by
the next. A lock keeps two collectors from one folder.
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
    """Packages by key, in a folder of its own; a key is ``task/number``. A context manager, because of the lock.

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
        """Puts a package on disk, all of it or nothing; one that is there already stays as it is."""
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
