"""Connections: websockets and HTTP over loopback, in this process, against fake servers on a bus of one thread."""

from __future__ import annotations

import http.client
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from protocol.messages import Mode
from sim_client.gateway import challenge, openpi
from sim_client.gateway.arrays import pack, unpack
from sim_client.gateway.exchange import Terms
from sim_client.gateway.http_form import HttpSide
from sim_client.gateway.memory import Memory
from sim_client.gateway.websocket import LIVE_UNDER_WAY, WebsocketSide

PictureOf = Callable[[int], np.ndarray]
MAX_BYTES = 20_000


def openpi_message(picture_of: PictureOf, **changes: Any) -> bytes:
    message = {
        "observation/image": picture_of(1),
        "observation/wrist_image": picture_of(2),
        "observation/state": np.zeros(3),
        "prompt": "pick",
    }
    return pack(message | changes, "openpi")


@pytest.fixture
def openpi_port(
    bench: Any, terms_with: Callable[..., Terms], working: Callable[..., Any], listening: Callable[..., Any]
) -> Iterator[int]:
    terms = terms_with(cameras=openpi.CAMERAS, state_key=openpi.STATE_KEY)
    with working(bench.machine), listening(WebsocketSide(bench.machine, terms, openpi.OpenpiDialect, MAX_BYTES)) as at:
        yield at


def client_at(port: int, **options: Any) -> ClientConnection:
    return connect(f"ws://127.0.0.1:{port}", compression=None, max_size=None, **options)


def ticks_of(client: ClientConnection, message: bytes, count: int) -> list[int]:
    found = []
    for _ in range(count):
        client.send(message)
        answer = client.recv(20)
        assert isinstance(answer, bytes), answer
        found.append(unpack(answer)["tick"])
    return found


def test_a_conversation_goes_on_after_what_could_not_be_read(openpi_port: int, picture_of: PictureOf) -> None:
    good = openpi_message(picture_of)
    with client_at(openpi_port) as client:
        assert unpack(client.recv(20))["control_hz"] == 20  # type: ignore[arg-type]
        assert ticks_of(client, good, 2) == [0, 1]
        for bad in (b"\xc1", "text", good[:-5], openpi_message(picture_of, prompt="")):
            client.send(bad)
            sentence = client.recv(20)
            assert isinstance(sentence, str)
            assert "expected" in sentence or "not a msgpack" in sentence
        assert ticks_of(client, good, 2) == [2, 3]


def test_the_client_that_holds_most_of_the_memory_is_disconnected_and_no_other(
    bench: Any,
    terms_with: Callable[..., Terms],
    working: Callable[..., Any],
    listening: Callable[..., Any],
    picture_of: PictureOf,
) -> None:
    terms = terms_with(cameras=openpi.CAMERAS, state_key=openpi.STATE_KEY)
    side = WebsocketSide(bench.machine, terms, openpi.OpenpiDialect, 10 << 20, memory=Memory(2 << 20))
    with working(bench.machine), listening(side) as port, client_at(port) as good, client_at(port) as hoarder:
        good.recv(20)
        hoarder.recv(20)
        assert ticks_of(good, openpi_message(picture_of), 1) == [0]
        hoarder.send(b"0" * (3 << 20))
        with pytest.raises(ConnectionClosedError, match="more than 2 MB: see --max-memory-mb"):
            hoarder.recv(20)
        assert ticks_of(good, openpi_message(picture_of), 3) == [1, 2, 3]
        assert side.memory.take(good, 0) is None


def test_a_message_beyond_the_limit_closes_that_connection_only(openpi_port: int, picture_of: PictureOf) -> None:
    good = openpi_message(picture_of)
    with client_at(openpi_port) as big:
        big.recv(20)
        big.send(b"0" * (MAX_BYTES + 1))
        with pytest.raises(ConnectionClosedError, match=r"1009.*too big.*20001.*20000"):
            big.recv(20)
    with client_at(openpi_port) as client:
        client.recv(20)
        assert ticks_of(client, good, 1) == [0]


def test_a_client_that_comes_back_begins_again(openpi_port: int, picture_of: PictureOf) -> None:
    good = openpi_message(picture_of)
    for _ in range(3):
        with client_at(openpi_port) as client:
            client.recv(20)
            assert ticks_of(client, good, 3) == [0, 1, 2]
            client.socket.shutdown(2)  # as a killed process leaves


def test_of_two_clients_one_drives_and_the_other_is_told(openpi_port: int, picture_of: PictureOf) -> None:
    good = openpi_message(picture_of)
    with client_at(openpi_port) as anna, client_at(openpi_port) as berta:
        for client in (anna, berta):
            client.recv(20)
        assert ticks_of(anna, good, 1) == [0]
        berta.send(good)
        assert "this robot is driven by" in str(berta.recv(20))
        assert ticks_of(anna, good, 1) == [1]
        anna.send(pack({"reset": True}, "openpi"))
        assert unpack(anna.recv(20)) == {"reset_finished": True}  # type: ignore[arg-type]
        assert ticks_of(berta, good, 2) == [0, 1]


def test_a_flood_is_read_no_faster_than_it_is_answered(
    picture_of: PictureOf, terms_with: Callable[..., Terms], listening: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Live, and nothing is ever answered: what lies in memory has an end, and another client is heard."""
    monkeypatch.setattr("sim_client.gateway.websocket._PING_S", 0.2)  # pings find that a client that is not read left
    asked: list[str] = []

    class Silent:
        def submit(self, client: str, request: Any) -> Future[Any]:
            asked.append(client)
            return Future()

    terms = terms_with(mode=Mode.REALTIME, cameras=openpi.CAMERAS, state_key=openpi.STATE_KEY)
    side = WebsocketSide(Silent(), terms, openpi.OpenpiDialect, MAX_BYTES)
    with listening(side) as port, client_at(port) as flooding, client_at(port) as patient:
        for client in (flooding, patient):
            client.recv(20)
        for _ in range(10 * LIVE_UNDER_WAY):
            flooding.send(openpi_message(picture_of))
        while len(asked) < LIVE_UNDER_WAY:
            time.sleep(0.01)
        patient.send(openpi_message(picture_of))
        while len(set(asked)) < 2:
            time.sleep(0.01)
        assert len(asked) == LIVE_UNDER_WAY + 1
        flooding.socket.shutdown(2)  # and one that leaves in the middle of it is noticed
        while len(asked) == LIVE_UNDER_WAY + 1:
            time.sleep(0.01)


def test_without_the_key_nobody_comes_in(
    bench: Any, terms_with: Callable[..., Terms], listening: Callable[..., Any]
) -> None:
    terms = terms_with(cameras=openpi.CAMERAS, state_key=openpi.STATE_KEY)
    side = WebsocketSide(bench.machine, terms, openpi.OpenpiDialect, MAX_BYTES, api_key="open sesame")
    with listening(side) as port:
        for headers in ({}, {"Authorization": "Api-Key guess"}):
            with pytest.raises(InvalidStatus, match="401"):
                client_at(port, additional_headers=headers)
        with client_at(port, additional_headers={"Authorization": "Api-Key open sesame"}) as client:
            assert isinstance(client.recv(20), bytes)


# -- the challenge, by a client written from its protocol


class ChallengeClient:
    """``reset`` and ``infer`` over HTTP; plays every row of an answer and brings back all it saw."""

    def __init__(self, port: int) -> None:
        self.port = port
        self._connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)

    def call(self, method: str, path: str, message: Any = None, **headers: str) -> tuple[int, bytes]:
        body = None if message is None else message if isinstance(message, bytes) else pack(message, "openpi")
        self._connection.request(method, path, body, headers)
        reply = self._connection.getresponse()
        return reply.status, reply.read()

    def play(self, picture_of: PictureOf, num_calls: int) -> list[np.ndarray]:
        """An episode with a video of three frames; returns the rows."""
        assert unpack(self.call("POST", "/reset", {"reset": True})[1]) == {"reset_finished": True}
        seen, first, chunks = [np.zeros(2)] * 4, True, []
        for _ in range(num_calls):
            status, body = self.call("POST", "/infer", _inputs(picture_of, seen, first))
            assert status == 200, body
            chunks.append(unpack(body)["actions"])
            seen, first = [row[:2] for row in chunks[-1]], False
        return chunks

    def close(self) -> None:
        self._connection.close()


def _inputs(picture_of: PictureOf, seen: list[np.ndarray], first: bool) -> dict[str, Any]:
    return {
        "task_goal": ["pick", "take"],
        "is_first_step": first,
        "front_rgb_list": [picture_of(1) for _ in seen],
        "wrist_rgb_list": [picture_of(2) for _ in seen],
        "joint_state_list": [joints.astype(np.float64) for joints in seen],
        "gripper_state_list": [np.array([0.0, 0.0]) for _ in seen],
        "front_depth_list": [np.zeros((4, 4, 1), np.int16) for _ in seen],
    }


@pytest.fixture
def challenger(
    bench_with: Callable[..., Any], terms_with: Callable[..., Terms], working: Callable[..., Any]
) -> Iterator[ChallengeClient]:
    bench = bench_with(num_rows=20)
    terms = terms_with(cameras=challenge.CAMERAS, rows=20)
    with HttpSide(("127.0.0.1", 0), bench.machine, terms, challenge.ChallengeDialect, MAX_BYTES) as side:
        thread = threading.Thread(target=side.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        thread.start()
        client = ChallengeClient(side.server_address[1])
        with working(bench.machine):
            yield client
        client.close()
        side.shutdown()
        thread.join(20)


def test_the_challenge_over_http_plays_episodes(challenger: ChallengeClient, picture_of: PictureOf) -> None:
    assert challenger.call("GET", "/healthz") == (200, b"OK\n")
    assert unpack(challenger.call("GET", "/metadata")[1])["rows"] == 20
    first, second = (challenger.play(picture_of, 3) for _ in range(2))
    assert [chunk.shape for chunk in first] == [(20, 3)] * 3
    assert not np.array_equal(np.concatenate(first), np.concatenate(second))  # each with its own noise


@pytest.mark.parametrize(
    ("method", "path", "message", "status", "sentence"),
    [
        ("POST", "/infer", b"\xc1", 400, b"not a msgpack"),
        ("POST", "/infer", {"is_first_step": True}, 400, b"expected 'front_rgb_list'"),
        ("POST", "/infer", b"0" * (MAX_BYTES + 1), 413, b"--max-message-mb"),
        ("POST", "/act", {}, 404, b"expected /reset or /infer"),
        ("GET", "/", None, 404, b"expected /healthz"),
    ],
)
def test_over_http_what_cannot_be_used_is_told_and_the_next_request_is_served(
    challenger: ChallengeClient, method: str, path: str, message: Any, status: int, sentence: bytes
) -> None:
    got, body = challenger.call(method, path, message)
    assert got == status
    assert sentence in body
    assert challenger.call("GET", "/healthz") == (200, b"OK\n")


def test_over_http_an_episode_that_was_not_begun_is_refused(challenger: ChallengeClient, picture_of: PictureOf) -> None:
    status, body = challenger.call("POST", "/infer", _inputs(picture_of, [np.zeros(2)] * 20, first=False))
    assert (status, b"no episode is open" in body) == (400, True)


# -- plain HTTP


@pytest.fixture(params=["websocket", "http"])
def plain_port(request: pytest.FixtureRequest) -> int:
    """The port of either side that answers plain HTTP."""
    if request.param == "websocket":
        return int(request.getfixturevalue("openpi_port"))
    return int(request.getfixturevalue("challenger").port)


@pytest.mark.parametrize("path", ["/healthz", "/healthz/", "/healthz?x=1", "/healthz/?x=/a", "/metadata", "/metadata?"])
def test_plain_http_gets_answers_and_head_gets_their_length(plain_port: int, path: str) -> None:
    replies = []
    for method in ("GET", "HEAD"):
        connection = http.client.HTTPConnection("127.0.0.1", plain_port, timeout=20)
        connection.request(method, path)
        reply = connection.getresponse()
        replies.append((reply.status, reply.headers["Content-Length"], reply.read()))
        connection.close()
    (status, length, body), head = replies
    assert (status, length, b"control_hz" in body) == (200, str(len(body)), path.startswith("/metadata"))
    assert head == (status, length, b"")


def test_after_head_the_connection_over_http_is_in_step(challenger: ChallengeClient) -> None:
    assert challenger.call("HEAD", "/healthz") == (200, b"")
    assert challenger.call("GET", "/healthz") == (200, b"OK\n")


def test_vla_eval_asks_for_health_under_its_own_name(openpi_port: int) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", openpi_port, timeout=20)
    connection.request("GET", "/health")
    assert connection.getresponse().status == 200
    connection.close()


def test_plain_http_finds_no_other_path(plain_port: int) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", plain_port, timeout=20)
    connection.request("GET", "/healthz/x")
    assert connection.getresponse().status in (404, 426)
    connection.close()
