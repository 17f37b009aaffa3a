"""What is on disk survives a power cut; what is merely written may not."""

import os
from pathlib import Path


def sync(path: Path) -> None:
    """Forces a file down to the disk; or a folder, without which a rename or a new file in it may be forgotten.

    Raises:
        OSError: the disk does not take it.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
