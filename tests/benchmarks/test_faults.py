"""Which faults are drawn, and what a proxy does to a link."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections import Counter
from collections.abc import Iterator

import pytest

from benchmarks.blows import KINDS, MOMENTS, SERVERS, draw
from benchmarks.fault_judge import tracebacks
from benchmarks.proxy import Proxy


def test_two_hundred_faults_are_of_every_kind_at_every_moment_and_may_be_repeated() -> None:
    faults = [draw(0, index) for index in range(200)]
    assert faults == [draw(0, index) for index in range(200)]
    assert faults != [draw(1, index) for index in range(200)]
    kinds, moments = Counter(f.kind for f in faults), Counter(f.moment for f in faults)
    assert kinds.keys() == KINDS.keys()
    assert min(kinds.values()) >= 200 // len(KINDS)
    assert min(moments[moment] for moment in MOMENTS) > 30
    assert all(0.2 <= f.seconds <= 5 for f in faults)
    struck = {f.victims for f in faults if f.kind == "killed"} | {f.victims for f in faults if f.kind == "frozen"}
    assert {1, 2, 3} <= {len(victims) for victims in struck}


def test_only_who_is_struck_may_fail() -> None:
    for index in range(200):
        fault = draw(0, index)
        assert fault.struck <= {*SERVERS, "sim"}
        if fault.kind in ("shm_full", "disk_full", "folder_read_only", "wall_clock_jumped", "tcp_cut", "tcp_stalled"):
            assert not fault.struck


def test_tracebacks_of_python_and_rust_are_counted() -> None:
    assert tracebacks("Traceback (most recent call last):\n  x\nthread 'a' panicked at src/x.rs:1") == 2
    assert tracebacks("ERROR no Traceback here") == 0


@pytest.fixture
def echo() -> Iterator[int]:
    """A port that sends back what it is sent."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    threading.Thread(target=send_back, args=(server.accept()[0],), daemon=True).start()

        def send_back(end: socket.socket) -> None:
            with contextlib.suppress(OSError), end:
                while data := end.recv(100):
                    end.sendall(data)

        threading.Thread(target=serve, daemon=True).start()
        yield server.getsockname()[1]


def test_a_proxy_holds_back_what_is_said_while_it_stalls_and_loses_nothing(echo: int) -> None:
    proxy = Proxy(echo)
    with socket.create_connection(("127.0.0.1", int(proxy.endpoint.rpartition(":")[2])), 5) as end:
        end.sendall(b"a")
        assert end.recv(1) == b"a"
        proxy.stall()
        end.sendall(b"b")
        end.settimeout(0.1)
        with pytest.raises(TimeoutError):
            end.recv(1)
        proxy.flow()
        end.settimeout(5)
        assert end.recv(1) == b"b"
    proxy.close()


def test_a_cut_proxy_ends_connections_and_takes_new_ones_when_it_flows_again(echo: int) -> None:
    proxy = Proxy(echo)
    at = ("127.0.0.1", int(proxy.endpoint.rpartition(":")[2]))
    with socket.create_connection(at, 5) as end:
        end.sendall(b"a")
        assert end.recv(1) == b"a"
        proxy.cut()
        assert end.recv(1) == b""
    proxy.flow()
    with socket.create_connection(at, 5) as end:
        end.sendall(b"c")
        assert end.recv(1) == b"c"
    proxy.close()
