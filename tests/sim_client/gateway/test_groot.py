"""GR00T's clients: their bytes are understood, what is not served is refused with a sentence, and nobody kills us."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.messages import Level
from protocol.peers.mapping import Camera, Numbers, PolicyMapping, Prompt
from sim_client.gateway.exchange import Answer, ClientRequest, Finish, Refused, Terms
from sim_client.gateway.groot import GrootDialect, GrootN15Dialect, check_mapping

zmq = pytest.importorskip("zmq", reason="pip install pyzmq")

MAPPING = PolicyMapping(
    name="gr00t",
    rate_hz=20,
    play_hz=20,
    horizon=4,
    num_proprio=3,
    num_commands=3,
    prompt=Prompt(key=("annotation.human.task_description",)),
    cameras=(Camera(camera="front", key=("ego_view",)), Camera(camera="wrist", key=("wrist_view",))),
    state=(
        Numbers(key=("arm",), columns=(0, 1), dims=(0, 1)),
        Numbers(key=("gripper",), columns=(0,), dims=(2,), scale=-1.0),
    ),
    actions=(
        Numbers(key=("arm",), columns=(0, 1), dims=(0, 1)),
        Numbers(key=("gripper",), columns=(0,), dims=(2,), scale=-1.0, kind="gripper"),
    ),
)
PICTURE = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)


def spelled(item: Any) -> Any:
    """An array as GR00T N1.5 and N1.6 send it."""
    file = io.BytesIO()
    np.save(file, item, allow_pickle=False)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


def understood(item: dict[Any, Any]) -> Any:
    if "__ndarray_class__" in item:
        return np.load(io.BytesIO(item["as_npy"]), allow_pickle=False)
    if b"nd" in item:
        return np.frombuffer(item[b"data"], item[b"type"]).reshape(item[b"shape"])
    return item


def packed(endpoint: str, data: Any = None, default: Callable[[Any], Any] = spelled, **more: Any) -> bytes:
    request = {"endpoint": endpoint, **more} | ({} if data is None else {"data": data})
    return msgpack.packb(request, default=default)


def unpacked(data: Any) -> Any:
    return msgpack.unpackb(data, object_hook=understood, strict_map_key=False)


def nested(text: str = "pick", batch: int = 1, time: int = 1) -> dict[str, Any]:
    observation = {
        "video": {name: np.broadcast_to(PICTURE, (batch, time, 4, 4, 3)) for name in ("ego_view", "wrist_view")},
        "state": {
            "arm": np.full((batch, time, 2), 0.1, np.float32), "gripper": np.full((batch, time, 1), 0.5, np.float32),
        },
        "language": {"annotation.human.task_description": [[text]] * batch},
    }  # fmt: skip
    return {"observation": observation, "options": None}


def flat(text: str = "pick", time: int = 1) -> dict[str, Any]:
    values = nested(text, 1, time)["observation"]
    arrays = {f"{kind}.{name}": array[0] for kind in ("video", "state") for name, array in values[kind].items()}
    return arrays | {"annotation.human.task_description": [text]}


@pytest.fixture(scope="module")
def terms(terms_with: Callable[..., Terms]) -> Terms:
    return terms_with(rows=4, mapping=MAPPING)


@pytest.fixture
def dialect(terms: Terms) -> GrootDialect:
    return GrootDialect(terms)


@pytest.mark.parametrize("is_flat", [False, True], ids=["N1.6", "N1.5"])
def test_an_observation_is_a_step(terms: Terms, is_flat: bool) -> None:
    dialect = GrootN15Dialect(terms) if is_flat else GrootDialect(terms)
    step = dialect.read(packed("get_action", flat() if is_flat else nested())).request
    assert (step.instruction, step.begins, step.may_begin) == ("pick", False, True)
    np.testing.assert_allclose(step.state, [0.1, 0.1, -0.5])
    assert sorted(step.frames) == ["front", "wrist"]
    assert (step.frames["front"] == PICTURE).all()


def test_rows_come_in_the_clients_arrays(dialect: GrootDialect) -> None:
    asked = dialect.read(packed("get_action", nested()))
    rows = np.arange(12, dtype=np.float32).reshape(4, 3)
    action, info = unpacked(dialect.answer(asked, Answer(rows_NA=rows, tick=7, levels=(Level.PLAY,) * 4)))
    assert (action["arm"].shape, action["gripper"].shape) == ((1, 4, 2), (1, 4, 1))
    assert (action["arm"][0] == rows[:, :2]).all()
    assert (action["gripper"][0, :, 0] == -rows[:, 2]).all()
    assert (info.pop("tick"), info.pop("levels")) == (7, ["PLAY"] * 4)
    assert info == {"subgoal": "", "subgoal_age_s": 0.0, "cognition_age_s": 0.0, "gate_score": None}


def test_a_client_of_n1_5_gets_flat_arrays(terms: Terms) -> None:
    dialect = GrootN15Dialect(terms)
    asked = dialect.read(packed("get_action", flat()))
    answer = unpacked(dialect.answer(asked, Answer(rows_NA=np.ones((4, 3), np.float32), tick=0, levels=())))
    assert {key: array.shape for key, array in answer.items()} == {"action.arm": (4, 2), "action.gripper": (4, 1)}


def test_a_client_of_the_newest_n1_7_is_answered_in_its_spelling(dialect: GrootDialect) -> None:
    def theirs(array: np.ndarray) -> Any:
        fields = {b"type": array.dtype.str, b"kind": b"", b"shape": array.shape, b"data": array.tobytes()}
        return {b"nd": True} | fields

    asked = dialect.read(packed("get_action", nested(), theirs))
    answer = dialect.answer(asked, Answer(rows_NA=np.ones((4, 3), np.float32), tick=0, levels=()))
    assert b"__ndarray_class__" not in answer
    assert unpacked(answer)[0]["arm"].shape == (1, 4, 2)


def test_another_instruction_and_a_reset_begin_an_episode(dialect: GrootDialect) -> None:
    assert not dialect.read(packed("get_action", nested("a"))).request.begins
    assert dialect.read(packed("get_action", nested("b"))).request.begins
    reset = dialect.read(packed("reset", {"options": None}))
    assert (reset.request, unpacked(reset.reply)) == (Finish(), {})
    assert not dialect.read(packed("get_action", nested("c"))).request.begins  # it begins because none is open


def test_the_modalities_are_the_mapping_files(terms: Terms) -> None:
    config = unpacked(GrootDialect(terms).read(packed("get_modality_config")).reply)
    assert {key: each["as_json"]["modality_keys"] for key, each in config.items()} == {
        "video": ["ego_view", "wrist_view"],
        "state": ["arm", "gripper"],
        "action": ["arm", "gripper"],
        "language": ["annotation.human.task_description"],
    }
    assert config["action"]["as_json"]["delta_indices"] == [0, 1, 2, 3]
    flat = unpacked(GrootN15Dialect(terms).read(packed("get_modality_config")).reply)
    assert json.loads(flat["video"]["as_json"])["modality_keys"] == ["video.ego_view", "video.wrist_view"]


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        (packed("kill"), "does not end this server"),
        (packed("get_weights"), "expected one of ping, get_modality_config, reset, get_action"),
        (packed("get_action", nested(batch=2)), r"2 robots in one request.*B = 1|one robot is driven at a time"),
        (packed("get_action", nested(time=2)), "2 instants in one request"),
        (packed("get_action"), "expected observation, a map by key"),
        (packed("get_action", {"observation": {}}), "expected language, a map by key"),
        (packed("get_action", flat()), "expected observation, a map by key"),
        (packed("get_action", [1]), "expected observation"),
        (packed("get_action", {"observation": nested()["observation"] | {"state": {"arm": 1}}}), "gripper|expected"),
        (b"\xc1", "not a msgpack message"),
        (packed("get_action", nested() | {"observation": nested()["observation"] | {"video": {}}}), "video.ego_view"),
    ],
)  # fmt: skip
def test_what_is_not_served_is_refused_with_a_sentence(dialect: GrootDialect, request_: bytes, said: str) -> None:
    with pytest.raises(Refused, match=said) as refused:
        dialect.read(request_)
    assert unpacked(dialect.refuse(str(refused.value))) == {"error": str(refused.value)}


PLAIN = st.none() | st.booleans() | st.integers(-5, 5) | st.floats() | st.text(max_size=3) | st.binary(max_size=3)
NAMES = st.sampled_from(["observation", "video", "state", "language", "ego_view", "arm", "gripper", "video.ego_view"])
ANYTHING = st.recursive(
    PLAIN | st.just(PICTURE) | st.just(PICTURE[None, None]),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(NAMES | st.integers(0, 2), inner, max_size=4),
    max_leaves=8,
)


@given(data=ANYTHING, is_flat=st.booleans(), endpoint=st.sampled_from(["get_action", "reset", "ping"]))
def test_whatever_a_client_sends_is_a_step_or_is_refused(terms: Terms, data: Any, is_flat: bool, endpoint: str) -> None:
    dialect = (GrootN15Dialect if is_flat else GrootDialect)(terms)
    for packet in (packed(endpoint, data), msgpack.packb(data, default=spelled)):
        with contextlib.suppress(Refused):
            dialect.read(packet)


def test_a_token_is_wanted_where_there_is_one(terms: Terms) -> None:
    dialect = GrootDialect(terms, "secret")
    for more in ({}, {"api_token": "other"}, {"api_token": 1}):
        with pytest.raises(Refused, match="Unauthorized"):
            dialect.read(packed("ping", **more))
    assert unpacked(dialect.read(packed("ping", api_token="secret")).reply)["status"] == "ok"


def test_a_robot_with_other_commands_than_the_file_is_refused(dialect: GrootDialect) -> None:
    with pytest.raises(Refused, match="maps 3 commands, the robot has 8"):
        dialect.answer(ClientRequest(None), Answer(rows_NA=np.zeros((1, 8), np.float32), tick=0, levels=()))


def test_only_positions_can_be_answered() -> None:
    velocity = dataclasses.replace(MAPPING.actions[0], kind="velocity", measured=(0, 1))
    with pytest.raises(ValueError, match="actions of kind velocity"):
        check_mapping(dataclasses.replace(MAPPING, actions=(velocity, MAPPING.actions[1])))


class Client:
    """As GR00T's own: a REQ socket, one request and one reply after the other."""

    def __init__(self, port: int) -> None:
        self._socket = zmq.Context.instance().socket(zmq.REQ)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVTIMEO, 20_000)
        self._socket.connect(f"tcp://127.0.0.1:{port}")

    def call(self, data: bytes) -> Any:
        self._socket.send(data)
        return unpacked(self._socket.recv())

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def serving(bench_with: Callable[..., Any], working: Callable[..., Any], terms: Terms) -> Iterator[int]:
    from sim_client.gateway.zmq_side import ZmqSide

    @contextmanager
    def serve() -> Iterator[int]:
        machine = bench_with(num_rows=4).machine
        side = ZmqSide(("127.0.0.1", 0), machine, terms, GrootDialect, 1 << 20)
        thread = threading.Thread(target=side.serve_forever, daemon=True)
        thread.start()
        try:
            with working(machine):
                yield side.port
        finally:
            side.shutdown()
            thread.join(10)

    with serve() as port:
        yield port


def test_a_client_plays_an_episode_and_another_one_after_a_reset(serving: int) -> None:
    client = Client(serving)
    assert client.call(packed("ping"))["status"] == "ok"
    ticks = []
    for _ in range(3):
        action, info = client.call(packed("get_action", nested()))
        ticks.append(info["tick"])
        assert action["arm"].shape == (1, 4, 2)
        assert np.isfinite(action["arm"]).all()
    assert ticks == [0, 4, 8]
    assert "does not end this server" in client.call(packed("kill"))["error"]
    client.call(packed("reset", {"options": None}))
    assert client.call(packed("get_action", nested()))[1]["tick"] == 0
    client.close()


def test_a_client_that_gave_up_comes_back_with_a_new_socket(serving: int) -> None:
    client = Client(serving)
    client.call(packed("get_action", nested()))
    client.close()
    again = Client(serving)
    assert again.call(packed("get_action", nested()))[1]["tick"] == 4
    again.close()


def test_a_message_of_another_socket_is_dropped_and_the_next_one_is_answered(serving: int) -> None:
    stranger = zmq.Context.instance().socket(zmq.DEALER)
    stranger.setsockopt(zmq.LINGER, 1000)
    stranger.connect(f"tcp://127.0.0.1:{serving}")
    stranger.send_multipart([b"a", b"b", b"c", b"d"])
    client = Client(serving)
    assert client.call(packed("ping"))["status"] == "ok"
    stranger.close()
    client.close()
