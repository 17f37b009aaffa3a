"""Files from outside: what a person hands to a command, and what a command writes for a person.

A file that is not what it should be ends in one sentence that names it: `reading` turns whatever a parser raises into
a `FileError`, `writing` puts the path into an error that lacks it (a full disk's, for one). `protocol.command_line`
prints them.
"""

from __future__ import annotations

import json
import os
import re
import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from protocol.errors import CommandError, FileError

MAX_TEXT_BYTES = 64 << 20  # the largest text that we write, 100,000 episodes of results, has about half of that
MAX_NPZ_BYTES = 256 << 20  # a pair with 48 s of two 256 px views at 5 Hz has 200 MB
MAX_TOKENIZER_BYTES = 100 << 20
"""Largest tokenizer that is parsed; Qwen3.5's and Gemma's have 12 and 34 MB."""

_LFS_POINTER = b"version https://git-lfs"
_MCAP = b"\x89MCAP0\r\n"


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """A block that parses ``path``: whatever it raises means that the file is no ``kind``.

    Raises:
        FileError: the block failed; the message names the file, what was expected, and what it is instead.
        OSError, CommandError: of the block itself; an OSError names the file.
    """
    try:
        yield
    except OSError as error:
        raise _named(error, path) from None
    except (FileError, CommandError):
        raise
    except Exception as error:  # a parser fails in its own ways: KeyError, RecursionError, a library's own class
        raise FileError(f"{path} is no {kind}: {_instead(path) or _reason(error)}") from error


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """A block that writes ``path``, or into this folder. Raises OSError that names it."""
    try:
        yield
    except OSError as error:
        raise _named(error, path) from None
    except Exception as error:
        if (number := re.search(r"os error (\d+)", str(error))) is None:
            raise
        raise _named(OSError(int(number[1]), ""), path) from error  # as libraries in Rust tell it


def folder(path: Path) -> Path:
    """Makes a folder for what a command writes, and its parents; returns it.

    Raises:
        OSError: it cannot be made or written to, or a file has its place.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise NotADirectoryError(f"{path} is a file; expected a folder, or a name for a new one") from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise PermissionError(f"{path} cannot be written to: not permitted, or a read-only disk")
    return path


def make_way(path: Path) -> None:
    """Makes the folder of a file that a command writes, and makes sure that no log has the file's place.

    Raises:
        OSError: the folder cannot be made or written to, or a log has the file's place.
    """
    folder(path.parent)
    if path.is_file():
        with path.open("rb") as file:
            if file.read(len(_MCAP)) == _MCAP:
                raise FileExistsError(f"{path} is a log: a record is never overwritten. Name another file")


def open_file(path: Path) -> BinaryIO:
    """Opens a regular file to read; a pipe or a device, which may have no end, is refused.

    Raises:
        OSError: it cannot be opened.
        FileError: it is no regular file.
    """
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # opening a pipe would wait for its writer
    mode = os.fstat(handle).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(handle, "rb")
    os.close(handle)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(f"{path} is a folder; expected a file")
    raise FileError(f"{path} is a pipe or a device; expected a file")


def read_text(path: Path, kind: str) -> str:
    """A text file in UTF-8.

    Raises:
        OSError: it cannot be read.
        FileError: it is no text, or larger than 64 MiB.
    """
    with reading(path, kind), open_file(path) as file:
        data = file.read(MAX_TEXT_BYTES + 1)
        if len(data) > MAX_TEXT_BYTES:
            raise ValueError(f"more than {MAX_TEXT_BYTES >> 20} MiB")
        return data.decode("utf-8-sig")


def read_word(path: Path, kind: str) -> str:
    """The only line of a text file, as secrets are kept. Raises OSError, FileError as `read_text`."""
    lines = read_text(path, kind).strip().splitlines()
    with reading(path, kind):
        if len(lines) != 1:
            raise ValueError(f"expected one word, came {len(lines)} lines")
    return lines[0]


def read_json(path: Path, kind: str) -> Any:
    """A JSON file's contents. Parse them within `reading`, since any value may have any type.

    Raises:
        OSError: it cannot be read.
        FileError: it is no JSON, or larger than 64 MiB.
    """
    text = read_text(path, kind)
    with reading(path, kind):
        return json.loads(text)


def read_npz(path: Path, kind: str, *, most_bytes: int = MAX_NPZ_BYTES) -> dict[str, NDArray[Any]]:
    """The arrays of an ``.npz`` file, by name. Check them within `reading`.

    Raises:
        OSError: it cannot be read.
        FileError: it is no such file, holds Python objects, or unpacks to more than ``most_bytes``.
    """
    with reading(path, kind), open_file(path) as file:
        with zipfile.ZipFile(file) as packed:  # a few kilobytes can claim gigabytes: sizes are looked at first
            unpacked = sum(entry.file_size for entry in packed.infolist())
        if unpacked > most_bytes:
            raise ValueError(f"its arrays have {unpacked} bytes, more than {most_bytes >> 20} MiB")
        file.seek(0)
        with np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}


def read_object(path: Path, kind: str = "JSON object") -> dict[str, Any]:
    """A JSON object, its values of any type.

    Raises:
        OSError: as `require_file`.
        FileError: as `require_file`, or it holds something else.
    """
    require_file(path, MAX_TEXT_BYTES)
    values = read_json(path, kind)
    if not isinstance(values, dict):
        raise FileError(f"{path} is no {kind}: it holds a {type(values).__name__}")
    return values


def require_file(path: Path, max_bytes: int | None = None) -> None:
    """Checks that ``path`` is a file with content, before a library is given its name.

    Raises:
        OSError: it is not there, or may not be read; the message names it.
        FileError: it is no file, is empty, is larger than ``max_bytes``, or is a Git LFS pointer to the real file.
    """
    if path.is_symlink() and not path.exists():
        raise FileNotFoundError(f"{path} links to {os.readlink(path)}, which is not there; download the folder again")
    with open_file(path) as file:
        num_bytes = os.fstat(file.fileno()).st_size
    if max_bytes is not None and num_bytes > max_bytes:
        raise FileError(f"{path} has {num_bytes} bytes; at most {max_bytes} are read")
    if instead := _instead(path):
        raise FileError(f"{path} is {instead}")


def _instead(path: Path) -> str:
    """What a file is that people often have in another's place; "" if it is none of these."""
    with open(path, "rb") as file:
        start = file.read(len(_LFS_POINTER))
    if start == _LFS_POINTER:
        return "a Git LFS pointer; fetch the file itself with: git lfs pull"
    return "" if start else "an empty file; fetch it again"


def _reason(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"{error.args[0]!r} is missing" if error.args else "a name is missing"
    if isinstance(error, RecursionError):
        return "nested too deeply"
    return str(error) or type(error).__name__


def _named(error: OSError, path: Path) -> OSError:
    if error.errno is None or error.filename is not None:
        return error
    return OSError(error.errno, error.strerror or os.strerror(error.errno), str(path))
