"""Odd values: whatever a client sends under whatever key is understood or refused, and its side goes on serving."""

from __future__ import annotations

import contextlib
import http.client
import json
import logging
import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from copy import copy
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from websockets.sync.client import connect

from protocol.peers.mapping import Camera, Numbers, PolicyMapping, Prompt
from sim_client.gateway import challenge, mme_vla, openpi, ponderpounce, reading, vla_eval
from sim_client.gateway.exchange import Answer, Refused, Step, Terms
from sim_client.gateway.groot import GrootDialect, GrootN15Dialect
from sim_client.gateway.http_form import HttpSide
from sim_client.gateway.websocket import WebsocketSide

MAX_BYTES = 1 << 20
SECRET = "open sesame"
PICTURE, STATE = np.zeros((4, 4, 3), np.uint8), np.zeros(3, np.float32)
DEEP = b"a thousand lists"
MAPPING = PolicyMapping(
    name="gr00t", rate_hz=20, play_hz=20, horizon=4, num_proprio=3, num_commands=3, prompt=Prompt(key=("task",)),
    cameras=(Camera(camera="front", key=("ego",)), Camera(camera="wrist", key=("hand",))),
    state=(Numbers(key=("arm",), columns=(0, 1, 2), dims=(0, 1, 2)),),
    actions=(Numbers(key=("arm",), columns=(0, 1, 2), dims=(0, 1, 2)),),
)  # fmt: skip

# -- what clients send, message by message


def _groot(data: Any) -> list[dict[str, Any]]:
    return [
        {"endpoint": endpoint, "api_token": SECRET, "data": content}
        for endpoint, content in (("ping", {}), ("get_action", data), ("reset", {"options": {}}))
    ]


SEEN = {"observation/image": PICTURE, "observation/wrist_image": PICTURE, "observation/state": STATE, "prompt": "pick"}
NESTED = {
    "video": {name: PICTURE[None, None] for name in ("ego", "hand")}, "state": {"arm": STATE[None, None]},
    "language": {"task": [["pick"]]},
}  # fmt: skip
FLAT = {"video.ego": PICTURE[None], "video.hand": PICTURE[None], "state.arm": STATE[None], "task": ["pick"]}
PICTURES = {"front": PICTURE, "wrist": PICTURE}
OBSERVED = {
    "images": PICTURES, "state": STATE, "state_ns": 1, "captured_ns": {"front": 1}, "robot_state": "ok",
    "robot_text": "well",
}  # fmt: skip
AT_OPENPI = {"cameras": openpi.CAMERAS, "state_key": openpi.STATE_KEY}
AT_GROOT = {"mapping": MAPPING, "rows": 4}
SPOKEN: dict[str, tuple[Callable[[Terms], Any], dict[str, Any], list[dict[str, Any]]]] = {
    "openpi": (
        openpi.OpenpiDialect, AT_OPENPI,
        [{"reset": True}, SEEN | {"reset": False, "demonstration": [PICTURE], "demonstration_hz": 1}],
    ),
    "challenge": (
        challenge.ChallengeDialect, {"cameras": challenge.CAMERAS, "rows": 1},
        [{"reset": True}]
        + [
            {"reset": False, "is_first_step": first, "task_goal": ["pick"], "front_rgb_list": [PICTURE],
             "wrist_rgb_list": [PICTURE], "joint_state_list": [STATE[:2]], "gripper_state_list": [STATE[:2]]}
            for first in (True, False)
        ],
    ),
    "mme-vla": (
        mme_vla.MmeVlaDialect, AT_OPENPI | {"rows": 1},
        [{"reset": True}]
        + 2 * [
            {"reset": False, "add_buffer": True, "images": PICTURE[None, None], "state": [STATE], "exec_start_idx": 0},
            SEEN | {"reset": False, "add_buffer": False},
        ],
    ),
    "vla-eval": (
        vla_eval.VlaEvalDialect, {"cameras": vla_eval.CAMERAS, "state_key": "states"},
        [
            {"type": kind, "payload": payload, "seq": seq}
            for seq, (kind, payload) in enumerate([
                ("hello", {"protocol_version": 1}),
                ("episode_start", {"task": {"name": "PickIt"}, "mode": "sync"}),
                ("observation", {"images": PICTURES, "states": STATE, "task_description": "pick",
                                 "video_history": [PICTURE], "wrist_video_history": [PICTURE]}),
                ("episode_end", {"metrics": {"success": True}, "steps": 3}),
            ])
        ],
    ),
    "ponderpounce": (
        ponderpounce.PonderpounceDialect, {"cameras": {"front": "front", "wrist": "wrist"}, "state_key": "state"},
        [
            {"kind": "time", "seq": 1},
            {"kind": "begin", "seq": 2, "instruction": "pick", "task": "", "speed": 1.0, "dry_run": False} | OBSERVED,
            {"kind": "observe", "seq": 3} | OBSERVED,
            {"kind": "end", "seq": 4, "success": True, "reason": "done"},
        ],
    ),
    "groot": (lambda terms: GrootDialect(terms, SECRET), AT_GROOT, _groot({"observation": NESTED, "options": None})),
    "groot-n1.5": (lambda terms: GrootN15Dialect(terms, SECRET), AT_GROOT, _groot(FLAT)),
}  # fmt: skip


def spelled(array: np.ndarray) -> dict[str, Any]:
    return {"__ndarray__": True, "data": array.tobytes(), "dtype": array.dtype.str, "shape": list(array.shape)}


def packed(message: Any) -> bytes:
    """A message, with lists in lists, deeper than msgpack packs them, where it says `DEEP`."""
    return bytes(msgpack.packb(message, default=spelled)).replace(msgpack.packb(DEEP), b"\x91" * 1000 + b"\x90")


def paths(value: Any, before: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every key of a message, with those of the maps within, and every list's first item."""
    inner = value.items() if isinstance(value, dict) else [(0, value[0])] if isinstance(value, list) and value else []
    for key, each in inner:
        yield (*before, key)
        yield from paths(each, (*before, key))


def changed(value: Any, path: tuple[Any, ...], odd: Any) -> Any:
    if not path:
        return odd
    found = copy(value)
    found[path[0]] = changed(value[path[0]], path[1:], odd)
    return found


# -- the laws

SIDES = st.lists(st.integers(0, 3), max_size=5)
TYPES = st.sampled_from(["u1", "b1", "f4", "i8", "U1"])
ARRAYS = st.builds(lambda sides, kind: np.zeros(sides, kind), SIDES, TYPES)
ENCODED = st.builds(
    lambda sides: {"__image__": True, "format": "png", "data": b"\x89PNG\r\n\x1a\n", "shape": sides}, SIDES
)
PLAIN = (
    st.none() | st.booleans() | st.integers(-(1 << 63), (1 << 64) - 1) | st.floats() | st.text(max_size=3)
    | st.binary(max_size=3)
)  # fmt: skip
JSON = st.text(max_size=3) | st.just(["\ud800"]) | st.just(10**400) | st.floats()
OF_JSON = JSON.map(lambda value: {"__ModalityConfig__": True, "as_json": json.dumps(value)})
KEYS = st.sampled_from(["a", "nd", "type", "data", "shape", "__npgeneric__", "__ndarray__", "__image__", "format"])
ODD = st.recursive(
    PLAIN | ARRAYS | ENCODED | OF_JSON | st.just(DEEP),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=6,
)


@pytest.mark.parametrize("name", SPOKEN)
def test_what_clients_send_is_understood(terms_with: Callable[..., Terms], name: str) -> None:
    new_dialect, changes, messages = SPOKEN[name]
    dialect = new_dialect(terms_with(**changes))
    for message in messages:
        dialect.read(packed(message))


@pytest.mark.parametrize("name", SPOKEN)
@given(odd=ODD)
@example(odd=np.array(3.0))
@example(odd=np.array([True, False]))
@example(odd=np.zeros(0))
@example(odd=[[1], [2, 3]])
@example(odd={"__image__": True, "format": "png", "data": b"", "shape": [1, 1, 4, 4, 3]})
@example(odd={"__ModalityConfig__": True, "as_json": '"\\ud800"'})
@example(odd={"__ModalityConfig__": True, "as_json": "1" + "0" * 400})
@example(odd={"nd": False, "type": "<U1", "data": b"a\0\0\0"})
@example(odd=DEEP)
@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@pytest.mark.filterwarnings("ignore:overflow encountered in cast:RuntimeWarning")
@pytest.mark.filterwarnings("ignore:invalid value encountered in cast:RuntimeWarning")
def test_whatever_stands_under_any_key_is_understood_or_refused(
    terms_with: Callable[..., Terms], name: str, odd: Any
) -> None:
    """The sentence of a refusal can be sent, and a video that is understood is one or is refused when it is read."""
    new_dialect, changes, messages = SPOKEN[name]
    terms = terms_with(**changes)
    for index, message in enumerate(messages):
        for path in paths(message):
            dialect = new_dialect(terms)
            for before in messages[:index]:
                dialect.read(packed(before))
            try:
                request = dialect.read(packed(changed(message, path, odd))).request
                if isinstance(request, Step):
                    list(request.demo)
            except Refused as refused:
                msgpack.packb(dialect.refuse(str(refused)))  # every letter of it can be sent


@given(flag=st.booleans(), depth=st.integers(0, 4), is_list=st.booleans())
def test_a_truth_value_may_be_the_only_item(flag: bool, depth: int, is_list: bool) -> None:
    assert reading.truth([flag] if is_list else np.full((1,) * depth, flag), "reset") is flag
    assert reading.truth(np.bool_(flag), "reset") is reading.truth(flag, "reset") is flag


@pytest.mark.parametrize("number", [0, 1, 0.0, 1.0, np.float32(1), np.int64(0), np.ones(1), [0]])
def test_nought_and_one_are_truth_values(number: Any) -> None:
    assert reading.truth(number, "success") is bool(np.ravel(number)[0])


@pytest.mark.parametrize("odd", [None, 2, -1, 0.5, math.nan, "true", b"\1", [], [True, True], [[True]], {"a": True}])
def test_what_is_no_truth_value_is_refused_with_its_key(odd: Any) -> None:
    with pytest.raises(Refused, match="reset: expected true or false, came"):
        reading.truth(odd, "reset")


@pytest.mark.parametrize(
    ("name", "index", "path", "odd", "sentence"),
    [
        ("openpi", 1, ("reset",), np.ones(2, bool), r"reset: expected true or false, came an array of shape \(2,\)"),
        ("openpi", 1, ("demonstration",), np.array(3), r"demonstration: expected a list, came an array of shape \(\)"),
        ("challenge", 1, ("is_first_step",), 2, "is_first_step: expected true or false, came 2"),
        ("challenge", 1, ("joint_state_list",), np.array(3), "joint_state_list: expected a list"),
        ("challenge", 1, ("joint_state_list", 0), [[1], [2, 3]], "joint_state_list: expected numbers, came list"),
        ("mme-vla", 1, ("add_buffer",), "yes", "add_buffer: expected true or false, came 'yes'"),
        ("mme-vla", 1, ("state",), np.array(3), "state: expected a list"),
        ("vla-eval", 0, ("payload", "protocol_version"), np.ones(2), "protocol_version: expected protocol version 1"),
        ("vla-eval", 2, ("payload", "wrist_video_history"), np.array(3), "wrist_video_history: expected a list"),
        ("vla-eval", 3, ("payload", "metrics", "success"), "yes", "metrics.success: expected true or false"),
        ("ponderpounce", 0, ("kind",), np.ones(2), "kind: expected time, begin, observe or end, came an array"),
        ("ponderpounce", 1, ("dry_run",), 2, "dry_run: expected true or false, came 2"),
        ("ponderpounce", 2, ("robot_text",), ["a"], "robot_text: expected a text, came list"),
        ("ponderpounce", 3, ("success",), 0.5, "success: expected true or false, came 0.5"),
        ("groot", 0, ("endpoint",), np.ones(2), "endpoint: expected one of ping, .*came an array"),
        ("groot", 0, ("api_token",), np.ones(2), "Unauthorized"),
    ],
)
def test_the_sentence_names_the_key(
    terms_with: Callable[..., Terms], name: str, index: int, path: tuple[Any, ...], odd: Any, sentence: str
) -> None:
    new_dialect, changes, messages = SPOKEN[name]
    dialect = new_dialect(terms_with(**changes))
    for before in messages[:index]:
        dialect.read(packed(before))
    with pytest.raises(Refused, match=sentence):
        dialect.read(packed(changed(messages[index], path, odd)))


def test_an_odd_mode_is_told_at_the_observation_and_the_next_start_is_served(terms_with: Callable[..., Terms]) -> None:
    new_dialect, changes, (_, start, observation, _) = SPOKEN["vla-eval"]
    dialect = new_dialect(terms_with(**changes))
    dialect.read(packed(changed(start, ("payload", "mode"), np.ones(2))))
    with pytest.raises(Refused, match="mode: expected sync or live, came an array"):
        dialect.read(packed(observation))
    dialect.read(packed(start))
    assert dialect.read(packed(observation)).request.begins


# -- sides that go on serving

Ask = Callable[[bytes], Any]


class Porter:
    """A door that keeps no robot. ``fails``: its first request is not taken, and its second fails at work."""

    def __init__(self, fails: bool = False) -> None:
        self.num_failures = 2 if fails else 0

    def submit(self, client: str, request: Any) -> Future[Answer | None]:
        future: Future[Answer | None] = Future()
        self.num_failures -= 1
        if self.num_failures == 1:
            raise ZeroDivisionError("a defect")
        if self.num_failures == 0:
            future.set_exception(ZeroDivisionError("a defect"))
        else:
            future.set_result(None)
        return future


@pytest.fixture(scope="session")
def serving(terms_with: Callable[..., Terms], listening: Callable[..., Any]) -> Callable[..., Any]:
    """A side of this dialect in front of this door, as a function from a client's message to its answer."""

    @contextmanager
    def in_thread(side: Any, port: int) -> Iterator[int]:
        thread = threading.Thread(target=side.serve_forever, daemon=True)
        thread.start()
        try:
            yield port
        finally:
            side.shutdown()
            thread.join(20)

    @contextmanager
    def over_http(new_dialect: Any, terms: Terms, door: Any) -> Iterator[Ask]:
        def ask(packet: bytes) -> str:
            client.request("POST", "/infer", packet)
            reply = client.getresponse()
            return f"{reply.status} {reply.read()!r}"

        with (
            HttpSide(("127.0.0.1", 0), door, terms, new_dialect, MAX_BYTES) as side,
            in_thread(side, side.server_address[1]) as port,
            contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=20)) as client,
        ):
            yield ask
            client.close()

    @contextmanager
    def over_zmq(new_dialect: Any, terms: Terms, door: Any) -> Iterator[Ask]:
        zmq = pytest.importorskip("zmq", reason="pip install pyzmq")
        from sim_client.gateway.zmq_side import ZmqSide

        side = ZmqSide(("127.0.0.1", 0), door, terms, new_dialect, MAX_BYTES)
        with in_thread(side, side.port) as port, zmq.Context.instance().socket(zmq.REQ) as client:
            client.setsockopt(zmq.LINGER, 0)
            client.setsockopt(zmq.RCVTIMEO, 20_000)
            client.connect(f"tcp://127.0.0.1:{port}")
            yield lambda packet: str(client.send(packet) or client.recv())

    @contextmanager
    def over_websocket(new_dialect: Any, terms: Terms, door: Any) -> Iterator[Ask]:
        side = WebsocketSide(door, terms, new_dialect, MAX_BYTES)
        with listening(side) as port, connect(f"ws://127.0.0.1:{port}", compression=None) as client:
            if new_dialect(terms).greeting() is not None:
                client.recv(20)
            yield lambda packet: str(client.send(packet) or client.recv(20))

    def serve(name: str, door: Any) -> Any:
        new_dialect, changes, _ = SPOKEN[name.removesuffix("-http")]
        over = over_http if name == "challenge-http" else over_zmq if name.startswith("groot") else over_websocket
        return over(new_dialect, terms_with(**changes), door)

    return serve


@pytest.mark.parametrize("name", [*SPOKEN, "challenge-http"])
def test_a_side_answers_odd_messages_and_goes_on(serving: Callable[..., Any], name: str) -> None:
    _, _, messages = SPOKEN[name.removesuffix("-http")]
    first = messages[0]
    with serving(name, Porter()) as ask:
        answer = ask(packed(first))
        assert "expected" not in answer
        for path in paths(first):
            for odd in (np.ones(2, bool), np.array(3.0), [[1], [2, 3]]):
                ask(packed(changed(first, path, odd)))
        assert "expected" not in ask(packed(first))


@pytest.mark.parametrize("name", ["openpi", "challenge-http", "groot"])
def test_a_defect_of_ours_is_told_and_logged_and_the_next_request_is_served(
    serving: Callable[..., Any], caplog: pytest.LogCaptureFixture, name: str
) -> None:
    _, _, messages = SPOKEN[name.removesuffix("-http")]
    reset = packed(messages[-1] if name == "groot" else {"reset": True})
    with serving(name, Porter(fails=True)) as ask:
        for _ in range(2):
            answer = ask(reset)
            assert "the gateway failed: ZeroDivisionError: a defect" in answer
            assert name != "challenge-http" or answer.startswith("500")
        assert "failed" not in ask(reset)
    defects = [record for record in caplog.records if record.levelno == logging.ERROR]
    assert [record.exc_info is not None for record in defects] == [True, True]
