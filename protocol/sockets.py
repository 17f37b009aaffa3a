"""Unix sockets: the links between processes of one host, which the operating system keeps for one user.

A socket lies in a folder that nobody else may enter. Loopback TCP, in contrast, is open to every user of the machine.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from protocol.errors import TransportError

SCHEME = "unixsock-stream/"
FOLDER = Path(f"/tmp/ponderpounce-{os.getuid() if hasattr(os, 'getuid') else 0}")
"""Folder of the daemons' own sockets. The same for a login shell and a service, whose environments differ."""
MAX_PATH_BYTES = 100
"""The kernel allows 108, and zenoh's lock beside a socket has five more."""


def endpoint(proc: str, folder: Path = FOLDER) -> str:
    """Where ``proc`` listens, in zenoh's form."""
    return f"{SCHEME}{folder}/{proc}.sock"


def socket_path(endpoint: str) -> Path | None:
    """The path of a socket; None for an endpoint of another kind."""
    return Path(endpoint.removeprefix(SCHEME)) if endpoint.startswith(SCHEME) else None


def make_private(path: Path) -> None:
    """Makes the folder of a socket if it is missing, and makes sure that no other user can enter it.

    Raises:
        TransportError: the folder is open to others, belongs to somebody else or cannot be made.
    """
    folder = path.parent
    if len(os.fsencode(path)) > MAX_PATH_BYTES:
        raise TransportError(f"socket {path}: expected at most {MAX_PATH_BYTES} bytes; use a shorter path")
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise TransportError(f"folder {folder} of a socket: {error.strerror}") from None
    mode = stat.S_IMODE(status.st_mode)
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or mode & 0o077:
        raise TransportError(
            f"folder {folder} of a socket: expected a folder of yours with mode 0700, came {mode:04o} of user "
            f"{status.st_uid}. Other users could join; remove it, or listen elsewhere: {SCHEME}FOLDER/NAME.sock"
        )
