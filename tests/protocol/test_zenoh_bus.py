"""The bus over real zenoh on loopback: what LocalBus promises, two sessions keep."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from protocol.bus import Sample
from protocol.errors import CallFailed, TransportError
from protocol.topics import Priority
from protocol.zenoh_bus import Endpoints, ZenohBus

pytestmark = [pytest.mark.e2e, pytest.mark.realtime]

PATIENCE_S = 5.0
MS = 1_000_000


def free_endpoint() -> str:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{s.getsockname()[1]}"


@pytest.fixture
def buses() -> Iterator[tuple[ZenohBus, ZenohBus]]:
    """One that listens and one that connects to it."""
    endpoint = free_endpoint()
    server = ZenohBus(Endpoints(listen=(endpoint,)))
    client = ZenohBus(Endpoints(connect=(endpoint,)))
    watching = server.watch_alive("alive/*")
    client.declare_alive("alive/client")
    assert await_(server, lambda: watching.drain())  # they see each other
    yield server, client
    client.close()
    server.close()


def await_(bus: ZenohBus, found: Callable[[], list[Sample]]) -> list[Sample]:
    """What ``found`` gives first, within the patience."""
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        if samples := found():
            return samples
        bus.wait(20 * MS)
    return []


def test_bytes_arrive_with_key_encoding_and_attachment(buses: tuple[ZenohBus, ZenohBus]) -> None:
    server, client = buses
    subscription = server.subscribe("pp/@v1/r0/ep/*/obs", keep=1)
    sent = Sample("pp/@v1/r0/ep/e1/obs", bytes(400_000), "application/protobuf;x.Y", b"attached")

    def send_and_look() -> list[Sample]:
        client.publish(sent.key, sent.payload, encoding=sent.encoding, attachment=sent.attachment,
                       priority=Priority.DATA_HIGH)  # fmt: skip
        return subscription.drain()

    assert await_(server, send_and_look)[-1] == sent


def test_a_call_is_answered_from_another_thread(buses: tuple[ZenohBus, ZenohBus]) -> None:
    server, client = buses
    inbox, is_over = server.serve("r0/@rpc/twice"), threading.Event()
    seen_by_client = client.watch_alive("alive/server")
    server.declare_alive("alive/server")
    assert await_(client, seen_by_client.drain)  # declared later: by now it knows who answers, too

    def answer() -> None:
        while not is_over.is_set():
            for request in inbox.drain():
                request.reply(request.payload * 2)
            server.wait(10 * MS)

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        assert client.call("r0/@rpc/twice", b"ab", timeout_ns=2_000 * MS) == b"abab"
    finally:
        is_over.set()
        thread.join(PATIENCE_S)


def test_a_call_that_nobody_serves_fails(buses: tuple[ZenohBus, ZenohBus]) -> None:
    with pytest.raises(CallFailed, match="nobody serves it"):
        buses[1].call("r0/@rpc/absent", b"", timeout_ns=300 * MS)


def test_a_call_that_is_not_answered_fails_in_time(buses: tuple[ZenohBus, ZenohBus]) -> None:
    server, client = buses
    server.serve("r0/@rpc/mute")
    start_s = time.monotonic()
    with pytest.raises(CallFailed):
        client.call("r0/@rpc/mute", b"", timeout_ns=300 * MS)
    assert time.monotonic() - start_s < PATIENCE_S


def test_a_token_goes_with_its_process(buses: tuple[ZenohBus, ZenohBus]) -> None:
    server, client = buses
    watching = server.watch_alive("alive/*")
    assert await_(server, watching.drain)[0].payload == b"1"
    client.close()
    gone = await_(server, watching.drain)
    assert [(sample.key, sample.payload) for sample in gone] == [("alive/client", b"")]


def test_a_taken_port_is_a_sentence(buses: tuple[ZenohBus, ZenohBus]) -> None:
    endpoint = free_endpoint()
    first = ZenohBus(Endpoints(listen=(endpoint,)))
    try:
        with pytest.raises(TransportError, match=r"does not open \(tcp/127\.0\.0\.1:\d+\).*Is another one there\?"):
            ZenohBus(Endpoints(listen=(endpoint,)))
    finally:
        first.close()
