"""Syncs files to disk, so that they survive a power cut."""

import os
from pathlib import Path


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
