"""Syncs files to disk, so that they survive a power cut; and tells a full disk from other errors."""

import errno
import os
import shutil
from pathlib import Path

FULL = (errno.ENOSPC, errno.EDQUOT)
"""Numbers of an OSError of a disk without room: what ends a record, and not the episode."""


def exchange(fresh: Path, folder: Path) -> None:
    """Renames a finished folder to ``folder``, in place of one that is there and then removed.

    A kill between both renames leaves neither, and the one that was there as ``folder.old``.
    """
    old = folder.with_name(folder.name + ".old")
    if folder.exists():
        shutil.rmtree(old, ignore_errors=True)
        folder.rename(old)
    fresh.rename(folder)
    sync(folder.parent)
    shutil.rmtree(old, ignore_errors=True)


def sync(path: Path) -> None:
    """Syncs a file; or a folder, without which a rename or a new file in it may be lost.

    Raises:
        OSError: the disk cannot be written.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
