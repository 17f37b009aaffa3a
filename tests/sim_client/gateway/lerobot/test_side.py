"""LeRobot's side of the gateway, message by message: each gets one answer, and none ends it."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.bus import Request
from protocol.peers.lerobot import Code, Envelope, WireError, unpack
from sim_client.gateway.exchange import Answer, Terms
from sim_client.gateway.lerobot import Session
from sim_client.gateway.lerobot_side import LerobotSide, _Pending
from sim_client.launch import free_ports

PIECES = st.none() | st.booleans() | st.integers(-5, 5) | st.floats() | st.text(max_size=3) | st.binary(max_size=3)
ANYTHING = st.recursive(
    PIECES, lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner, max_size=3)
)
KINDS = ["describe", "open", "control", "observation", "language_request", "ack", "action", "error", "nonsense"]


@given(kind=st.sampled_from(KINDS), body=ANYTHING, version=st.sampled_from([1, 1, 1, 2, "1"]), cut=st.integers(0, 9))
def test_whatever_comes_is_answered_and_ends_nothing(
    silent_side: LerobotSide, wire: Any, kind: str, body: Any, version: Any, cut: int
) -> None:
    """Every message gets one answer of this wire; none takes a seat."""
    ids = {"instance_id": silent_side.deployment.instance_id, "session_id": "s", "request_id": "r", "generation": 0}
    packet = msgpack.packb({"version": version, "message_type": kind, "body": body, **ids})
    for data in (packet, packet[:-cut] if cut else b""):
        answers: list[bytes] = []
        silent_side._handle(Request(data, answers.append))
        (answer,) = answers
        envelope = unpack(answer)
        assert envelope.kind == (
            "descriptor" if data == packet and kind == "describe" and _is_whole(wire, body, version) else "error"
        )
        assert envelope.kind != "error" or envelope.body["code"] in list(Code)
    assert not silent_side.deployment.sessions


def test_an_answer_that_fails_is_an_error_to_its_client_and_ends_nothing(silent_side: LerobotSide) -> None:
    future: Future[Answer | None] = Future()
    future.set_exception(ZeroDivisionError("a defect"))
    answers: list[bytes] = []
    session = Session(silent_side.deployment.terms, "sha", is_aligned=False)
    waiting = Envelope(kind="observation", session_id=session.id, request_id="r")
    silent_side._pending.append(_Pending(waiting, session, future, answers.append))
    silent_side._reply()
    (told,) = map(unpack, answers)
    assert (told.kind, told.request_id, told.body["code"]) == ("error", "r", Code.EXECUTION)
    assert told.body["message"] == "the gateway failed: ZeroDivisionError: a defect"


def _is_whole(wire: Any, body: Any, version: Any) -> bool:
    """Whether LeRobot's codec takes a message with this body."""
    try:
        unpack(wire.enveloped("describe", body))
    except WireError:
        return False
    return version == 1 and type(version) is int


@pytest.fixture(scope="module")
def silent_side(terms: Terms) -> Iterator[LerobotSide]:
    """A side that nobody works for, in front of no seat."""

    class Nobody:
        models = ("sha",)

        def unready(self) -> str:
            return "pounce is loading"

    side = LerobotSide(("127.0.0.1", free_ports(1)[0]), Nobody(), terms, 1)  # type: ignore[arg-type]
    yield side
    side._bus.close()
