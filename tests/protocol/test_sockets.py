"""A Unix socket lies where no other user can reach it, or nothing listens."""

from __future__ import annotations

import errno
import os
import socket
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.errors import TransportError
from protocol.sockets import MAX_PATH_BYTES, endpoint, make_private, socket_path
from protocol.topics import Priority
from protocol.zenoh_bus import Endpoints, ZenohBus


@pytest.fixture
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:  # short: pytest's own are too long for a socket
        yield Path(name)


def test_a_missing_folder_is_made_for_this_user_alone(folder: Path) -> None:
    make_private(folder / "new" / "clock.sock")
    assert stat.S_IMODE((folder / "new").stat().st_mode) == 0o700


@pytest.mark.parametrize("mode", [0o755, 0o710, 0o701, 0o777])
def test_a_folder_that_others_may_enter_is_refused_by_name(folder: Path, mode: int) -> None:
    folder.chmod(mode)
    with pytest.raises(TransportError, match=f"folder {folder} of a socket: .* mode 0700, came {mode:04o}"):
        ZenohBus(Endpoints(listen=(endpoint("clock", folder),)))


def test_a_link_to_a_folder_is_refused(folder: Path) -> None:
    (folder / "real").mkdir(mode=0o700)
    (folder / "link").symlink_to(folder / "real")
    with pytest.raises(TransportError, match="expected a folder of yours"):
        make_private(folder / "link" / "clock.sock")


def test_a_path_that_the_kernel_would_cut_is_refused(folder: Path) -> None:
    with pytest.raises(TransportError, match="at most 100 bytes"):
        make_private(folder / ("x" * MAX_PATH_BYTES) / "clock.sock")


def test_only_socket_endpoints_have_a_path() -> None:
    assert socket_path(endpoint("clock", Path("/a"))) == Path("/a/clock.sock")
    assert socket_path("tcp/127.0.0.1:7447") is None


def test_messages_pass_through_a_socket_and_a_dead_listener_does_not_stop_the_next(folder: Path) -> None:
    at = endpoint("clock", folder)
    dead = f"import os; from protocol.zenoh_bus import *; bus = ZenohBus(Endpoints(listen=({at!r},))); os._exit(9)"
    assert subprocess.run([sys.executable, "-c", dead], check=False).returncode == 9
    assert socket_path(at).exists()  # type: ignore[union-attr]
    server, client = ZenohBus(Endpoints(listen=(at,))), ZenohBus(Endpoints(connect=(at,)))
    try:
        heard = server.subscribe("a/b", keep=1)
        for _ in range(500):
            client.publish("a/b", b"hello", encoding="x", attachment=b"", priority=Priority.DATA)
            server.wait(20_000_000)
            if samples := heard.drain():
                break
        assert samples[0].payload == b"hello"
        assert server.is_local
    finally:
        client.close()
        server.close()


def knock_as(user: int, path: Path) -> int:
    """Connects to a socket as another user; returns the error number, 0 if it opens."""
    child = os.fork()
    if child == 0:  # only system calls here: this process has threads
        os.setuid(user)
        os._exit(socket.socket(socket.AF_UNIX).connect_ex(str(path)))
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody else")
def test_another_user_of_the_machine_cannot_open_the_socket(folder: Path) -> None:
    make_private(folder / "ours" / "clock.sock")
    folder.chmod(0o755)
    server = ZenohBus(Endpoints(listen=(endpoint("clock", folder / "ours"),)))
    try:
        knocked = [knock_as(user, folder / "ours" / "clock.sock") for user in (0, 65534)]
    finally:
        server.close()
    assert knocked == [0, errno.EACCES]
