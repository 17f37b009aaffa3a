"""Syncs files to disk, so that they survive a power cut; and tells a full disk from other errors."""

import errno
import os
from pathlib import Path

FULL = (errno.ENOSPC, errno.EDQUOT)
"""Numbers of an OSError of a disk without room: what ends a record, and not the episode."""


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
