"""A GR00T policy server as POUNCE: its modalities are compared with the mapping file, its late answers never played."""

from __future__ import annotations

import dataclasses
import io
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import msgpack
import numpy as np
import pytest

from pounce_server.contract import Window, example_request
from pounce_server.remote.engine import RemoteEngine
from protocol.messages import ObservationWindow
from protocol.peers.mapping import Camera, Numbers, PolicyMapping, Prompt

zmq = pytest.importorskip("zmq", reason="pip install pyzmq")

LANGUAGE = "annotation.human.task_description"


def spelled(array: Any) -> Any:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


def spelled_by_the_newest(array: Any) -> Any:
    fields = {b"type": array.dtype.str, b"kind": b"", b"shape": array.shape, b"data": array.tobytes()}
    return {b"nd": True} | fields


def understood(item: dict[Any, Any]) -> Any:
    return np.load(io.BytesIO(item["as_npy"])) if "__ndarray_class__" in item else item


@dataclass
class GrootServer:
    """Endpoints as the public server dispatches them: one request after the other, an exception is an error's text."""

    is_flat: bool = False
    spell: Callable[[Any], Any] = spelled
    token: str = ""
    config: dict[str, Any] = field(default_factory=dict)
    seen: list[Any] = field(default_factory=list)
    calls: list[str] = field(default_factory=list)
    script: Callable[[Any], Any] | None = None
    port: int = 0

    def __post_init__(self) -> None:
        keys = {
            "video": ["ego_view"],
            "state": ["arm", "gripper"],
            "action": ["arm", "gripper"],
            "language": [LANGUAGE],
        }
        for name, names in keys.items():
            indices = list(range(20)) if name == "action" else [0]
            prefix = f"{name}." if self.is_flat and name != "language" else ""
            self.config[name] = {"delta_indices": indices, "modality_keys": [prefix + each for each in names]}

    @property
    def url(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def answer(self, request: dict[str, Any]) -> Any:
        if self.token and request.get("api_token") != self.token:
            return {"error": "Unauthorized: Invalid API token"}
        self.calls.append(request["endpoint"])
        if request["endpoint"] == "ping":
            return {"status": "ok", "message": "Server is running"}
        if request["endpoint"] == "get_modality_config":
            return {
                name: {"__ModalityConfig_class__": True, "as_json": json.dumps(each) if self.is_flat else each}
                for name, each in self.config.items()
            }
        if request["endpoint"] == "reset":
            return {}
        observation = request["data"] if self.is_flat else request["data"]["observation"]
        self.seen.append(observation)
        if self.script is not None:
            return self.script(observation)
        if self.is_flat:
            return {
                "action.arm": np.tile(observation["state.arm"], (20, 1)),
                "action.gripper": np.tile(observation["state.gripper"][0], 20),
            }
        return [{name: np.tile(array, (1, 20, 1)) for name, array in observation["state"].items()}, {}]

    @contextmanager
    def running(self) -> Iterator[GrootServer]:
        socket = zmq.Context.instance().socket(zmq.REP)
        socket.setsockopt(zmq.LINGER, 0)
        self.port = socket.bind_to_random_port("tcp://127.0.0.1")
        ends = threading.Event()

        def serve() -> None:
            while not ends.is_set():
                if socket.poll(20):
                    request = msgpack.unpackb(socket.recv(), object_hook=understood)
                    try:
                        answer = self.answer(request)
                    except Exception as error:
                        answer = {"error": str(error)}
                    socket.send(answer if isinstance(answer, bytes) else msgpack.packb(answer, default=self.spell))
            socket.close()

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        try:
            yield self
        finally:
            ends.set()
            thread.join(10)


@pytest.fixture(scope="module")
def named(mapping: PolicyMapping) -> PolicyMapping:
    slices = (
        Numbers(key=("arm",), columns=(0, 1), dims=(0, 1)), Numbers(key=("gripper",), columns=(0,), dims=(2,)),
    )  # fmt: skip
    cameras = (Camera(camera="front", key=("ego_view",)), Camera(camera="wrist", key=None))
    return dataclasses.replace(
        mapping, prompt=Prompt(key=(LANGUAGE,)), cameras=cameras, state=slices, actions=slices
    )  # fmt: skip


PEERS: list[Any] = []


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    yield
    while PEERS:
        PEERS.pop().close()


def engine_of(server: GrootServer, mapping: PolicyMapping, answer_s: float = 5.0, token: str = "") -> RemoteEngine:
    from pounce_server.remote.groot import GrootPeer

    peer = GrootPeer(server.url, mapping, is_flat=server.is_flat, api_token=token)
    PEERS.append(peer)
    return RemoteEngine(peer, mapping, server.url, answer_s=answer_s, start_s=5)


def request_of(engine: RemoteEngine) -> Any:
    return dataclasses.replace(
        example_request(engine.spec, frame_px=8), previous_rows=None, committed_rows=0,
        proprio=np.array([0.1, 0.2, 0.3], np.float32),
    )  # fmt: skip


@pytest.mark.parametrize(
    "server",
    [GrootServer(), GrootServer(spell=spelled_by_the_newest), GrootServer(is_flat=True), GrootServer(token="secret")],
    ids=["N1.6", "newest N1.7", "N1.5", "with a token"],
)
def test_rows_are_the_policys(server: GrootServer, named: PolicyMapping) -> None:
    with server.running():
        engine = engine_of(server, named, token=server.token)
        np.testing.assert_allclose(engine.invoke(request_of(engine)), np.tile([0.1, 0.2, 0.3], (20, 1)), rtol=1e-6)
    video = server.seen[-1]["video.ego_view"] if server.is_flat else server.seen[-1]["video"]["ego_view"]
    assert video.shape == ((1, 8, 8, 3) if server.is_flat else (1, 1, 8, 8, 3))


@pytest.mark.parametrize("is_flat", [False, True])
def test_a_window_is_seen_by_the_server(named: PolicyMapping, is_flat: bool) -> None:
    window = ObservationWindow(video_ticks=(-15, 0), state_ticks=(-2, -1, 0))
    server = GrootServer(is_flat=is_flat)
    server.config["video"]["delta_indices"], server.config["state"]["delta_indices"] = [-15, 0], [-2, -1, 0]
    states_TP = np.arange(9, dtype=np.float32).reshape(3, 3)
    pictures = tuple(np.full((8, 8, 3), shade, np.uint8) for shade in (3, 200))
    last = {"arm": np.zeros((1, 20, 2)), "gripper": np.zeros((1, 20, 1))}
    flat = {f"action.{name}": array[0] for name, array in last.items()}
    server.script = lambda seen: flat if is_flat else [last, {}]
    with server.running():
        engine = engine_of(server, dataclasses.replace(named, window=window))
        seen = Window(
            frames=(pictures, pictures), states_TP=states_TP, is_video_padded_T=np.array([True, False]),
            is_state_padded_T=np.zeros(3, np.bool_),
        )  # fmt: skip
        engine.invoke(dataclasses.replace(request_of(engine), window=seen))
        assert len(engine.warm_up()) == 20
    probed, asked = server.seen[0], server.seen[1]
    if not is_flat:
        assert probed["video"]["ego_view"].shape == (1, 2, 256, 256, 3)
        asked = {f"{name}.{key}": array[0] for name in ("video", "state") for key, array in asked[name].items()}
    np.testing.assert_array_equal(asked["video.ego_view"], np.stack(pictures))
    np.testing.assert_array_equal(asked["state.arm"], states_TP[:, :2])
    np.testing.assert_array_equal(asked["state.gripper"], states_TP[:, 2:])


def test_a_window_is_in_the_ticks_of_the_robot(named: PolicyMapping) -> None:
    window = ObservationWindow(video_ticks=(-10, 0))
    server = GrootServer()
    server.config["video"]["delta_indices"] = [-5, 0]
    with server.running():
        engine_of(server, dataclasses.replace(named, window=window, play_hz=40))
        with pytest.raises(ValueError, match=r"test looks at \[-5, 0\] ticks at 40 Hz"):
            engine_of(server, dataclasses.replace(named, play_hz=40, window=ObservationWindow(video_ticks=(-5, 0))))


def test_a_mask_has_no_place_on_this_wire(named: PolicyMapping) -> None:
    from pounce_server.remote.groot import GrootPeer

    with pytest.raises(ValueError, match="leave video_pad and state_pad out"):
        GrootPeer("tcp://127.0.0.1:9", dataclasses.replace(named, video_pad=("pad",)), is_flat=False)


def test_an_episode_begins_with_a_reset(named: PolicyMapping, episode_info: Callable[..., Any], paper: Any) -> None:
    with GrootServer().running() as server:
        engine_of(server, named).begin(episode_info(paper))
        assert server.calls == ["ping", "get_modality_config", "get_action", "reset"]


@pytest.mark.parametrize(
    ("modality", "change", "said"),
    [
        (
            "video",
            {"modality_keys": ["ego_view", "wrist_view"]},
            "its video keys are ego_view, wrist_view; test has ego",
        ),
        ("state", {"modality_keys": ["arm"]}, "its state keys are arm; test has arm, gripper"),
        ("action", {"modality_keys": ["arm", "gripper", "waist"]}, "its action keys are arm, gripper, waist"),
        ("language", {"modality_keys": ["task"]}, "its language keys are task"),
        ("action", {"delta_indices": list(range(16))}, r"its action has 16 steps, expected 20 \(horizon\)"),
        ("video", {"delta_indices": [-15, 0]}, r"its video has the steps \[-15, 0\], test looks at \[0\]; say so in"),
        ("state", {"delta_indices": [-1]}, r"its state has the steps \[-1\], test looks at \[0\]"),
        ("state", {"delta_indices": ["0"]}, r"its state has the steps \['0'\], test looks at \[0\]"),
        ("language", {"delta_indices": [-1, 0]}, "its language has 2 steps, expected 1"),
        ("video", {"delta_indices": None}, "expected a modality configuration with video"),
    ],
)
def test_other_modalities_are_refused_before_anything_moves(
    named: PolicyMapping, modality: str, change: dict[str, Any], said: str
) -> None:
    server = GrootServer()
    server.config[modality] |= change
    with server.running(), pytest.raises(ValueError, match=said):
        engine_of(server, named)
    assert server.seen == []


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ([{"arm": np.zeros((1, 20, 2))}, {}], "answers with arm; test expects arm, gripper"),
        ([{"arm": np.zeros((1, 20, 7)), "gripper": np.zeros((1, 20, 1))}, {}], r"'arm' is \(20, 7\)"),
        ([{"arm": np.zeros((2, 20, 2)), "gripper": np.zeros((2, 20, 1))}, {}], r"'arm' is \(2, 20, 2\)"),
        ([{"arm": np.zeros((1, 20, 2)), "gripper": np.full((1, 20, 1), np.nan)}, {}], "nan in row 0"),
        ({"error": "Missing key: video.ego_view"}, "it says: Missing key"),
        ({}, "expected actions by key, came NoneType"),
        (b"ERROR", "expected actions by key|expected GR00T's msgpack"),
    ],
)
def test_another_first_answer_is_refused(named: PolicyMapping, answer: Any, said: str) -> None:
    with GrootServer(script=lambda seen: answer).running() as server, pytest.raises(ValueError, match=said):
        engine_of(server, named)


def test_a_wrong_token_is_told(named: PolicyMapping) -> None:
    with GrootServer(token="secret").running() as server, pytest.raises(ValueError, match="it says: Unauthorized"):
        engine_of(server, named)


def test_a_late_answer_is_not_the_next_ones(named: PolicyMapping) -> None:
    with GrootServer().running() as server:
        engine = engine_of(server, named, answer_s=0.5)
        late = [{"arm": np.full((1, 20, 2), 9.0), "gripper": np.full((1, 20, 1), 9.0)}, {}]
        server.script = lambda seen: time.sleep(0.8) or late
        beats: list[int] = []
        with pytest.raises(ValueError, match=r"no answer within 0\.5 s"):
            engine.invoke(request_of(engine), lambda: beats.append(1))
        assert len(beats) > 3
        server.script = None
        np.testing.assert_allclose(engine.invoke(request_of(engine))[0], [0.1, 0.2, 0.3], rtol=1e-6)


def test_without_a_server_the_start_ends_with_a_sentence(named: PolicyMapping) -> None:
    from pounce_server.remote.groot import GrootPeer

    for url, said in (("tcp://127.0.0.1:9", "no answer within 0.2 s"), ("127.0.0.1:5555", "expected tcp://HOST:PORT")):
        with pytest.raises(ValueError, match=said):
            RemoteEngine(GrootPeer(url, named, is_flat=False), named, url, answer_s=1, start_s=0.2)
