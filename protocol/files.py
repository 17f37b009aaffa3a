"""Files from elsewhere: refused with a sentence that names them, before a parser sees them."""

import json
import os
import stat
from pathlib import Path
from typing import Any

MAX_JSON_BYTES = 16 * 2**20
MAX_TOKENIZER_BYTES = 100 * 2**20
"""Largest tokenizer that is parsed; Qwen3.5's and Gemma's have 12 and 34 MB."""
_LFS_POINTER = b"version https://git-lfs.github.com/spec/"


def require_file(path: Path, max_bytes: int | None = None) -> None:
    """Checks that ``path`` is a readable file with content.

    Raises:
        OSError: it is not there, or may not be read; the message names it.
        ValueError: it is no file, is empty, is larger than ``max_bytes``, or is a Git LFS pointer to the real file.
    """
    if path.is_symlink() and not path.exists():
        raise FileNotFoundError(f"{path} links to {os.readlink(path)}, which is not there; download the folder again")
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):  # a pipe or a device would never end
        raise ValueError(f"{path} is not a regular file")
    if status.st_size == 0:
        raise ValueError(f"{path} is empty; download it again")
    if max_bytes is not None and status.st_size > max_bytes:
        raise ValueError(f"{path} has {status.st_size} bytes; at most {max_bytes} are read")
    with path.open("rb") as file:
        if file.read(len(_LFS_POINTER)) == _LFS_POINTER:
            raise ValueError(f"{path} is a Git LFS pointer, not the file itself; run `git lfs pull` in its folder")


def read_object(path: Path) -> dict[str, Any]:
    """Reads a JSON object.

    Raises:
        OSError: as `require_file`.
        ValueError: as `require_file`, or the file holds no JSON object; the message names it.
    """
    require_file(path, MAX_JSON_BYTES)
    try:
        values = json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no JSON, or was cut short: {error}") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path}: expected a JSON object, came {type(values).__name__}")
    return values
