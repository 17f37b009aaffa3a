"""LeRobot's policy server as POUNCE, held to the exchange that its public sources describe: a server of that wire."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import msgpack
import numpy as np
import pytest

from pounce_server.contract import example_request
from pounce_server.remote.engine import RemoteEngine
from pounce_server.remote.lerobot import LerobotPeer
from protocol.messages import ObservationWindow
from protocol.peers.mapping import Camera, Numbers, PolicyMapping, Prompt
from protocol.topics import Priority
from protocol.zenoh_bus import Endpoints, ZenohBus
from sim_client.launch import free_ports

ROOT = "lerobot/inference/v1/deployments/arm"
STATE, FRONT = "observation.state", "observation.images.front"


def tensor(array: np.ndarray) -> dict[str, Any]:
    return {
        "__lerobot_type__": "tensor", "dtype": str(array.dtype), "shape": list(array.shape), "endianness": "little",
        "data": array.tobytes(),
    }  # fmt: skip


def feature(name: str, shape: tuple[int, ...], kind: str) -> dict[str, Any]:
    dtype = "uint8" if kind == "rgb" else "float32"
    return {"name": name, "shape": list(shape), "dtype": dtype, "kind": kind, "names": [], "semantics": "test"}


@dataclass
class LerobotServer:
    """One deployment, one instance, one seat."""

    port: int = field(default_factory=lambda: free_ports(1)[0])
    capabilities: dict[str, Any] = field(default_factory=dict)
    ready: bool = True
    seen: list[dict[str, Any]] = field(default_factory=list)
    calls: list[str] = field(default_factory=list)
    script: Callable[[dict[str, Any]], Any] | None = None
    generation: int = 0
    num_sessions: int = 0
    is_taken: bool = False

    def __post_init__(self) -> None:
        features = [feature(STATE, (3,), "tensor"), feature(FRONT, (8, 8, 3), "rgb")]
        self.capabilities = {
            "modes": ["chunk"], "prediction_steps": 20, "execution_steps": 20, "action_interval": 0.05,
            "features": features, "action_feature": feature("action", (3,), "tensor"), "language": False,
            "current_observation_only": True, "retains_session_state": False, "action_representation": "canonical",
        }  # fmt: skip

    @property
    def url(self) -> str:
        return f"tcp/127.0.0.1:{self.port}#arm"

    def descriptor(self) -> dict[str, Any]:
        return {
            "deployment": "arm", "instance_id": "1" * 32, "artifact_identity": "sha256:abc", "semantics": "test",
            "capabilities": self.capabilities, "execution_contracts": ["chunk_alignment_v2"], "ready": self.ready,
            "available": not self.is_taken, "failure": None, "session_status": "idle",
        }  # fmt: skip

    def replied(self, asked: dict[str, Any]) -> tuple[str, dict[str, Any]]:
        kind, body = asked["message_type"], asked["body"]
        self.calls.append(body.get("operation", kind))
        if kind == "describe":
            return "descriptor", self.descriptor()
        if kind == "open":
            if self.is_taken:
                return "error", {"code": "busy", "message": "another client", "details": {}}
            self.num_sessions += 1
            self.is_taken, self.generation = True, 0
            asked["session_id"] = f"{self.num_sessions}" * 32
            return "accepted", {**self.descriptor(), "mode": "chunk", "chunk_settings": {}}
        if body["operation"] == "close":
            self.is_taken = False
        self.generation = asked["generation"]
        return "ack", {"operation": body["operation"], "applied_generation": self.generation}

    def acted(self, asked: dict[str, Any]) -> tuple[str, dict[str, Any]]:
        body = asked["body"]
        self.seen.append(body)
        if asked["generation"] != self.generation:
            return "error", {"code": "stale", "message": "another generation"}
        if self.script is not None:
            return self.script(body)
        state = np.frombuffer(body["features"][STATE]["data"], np.float32)
        return "action", {"canonical_actions": tensor(np.tile(state, (20, 1))), "execution_steps": 20}

    @contextmanager
    def running(self) -> Iterator[LerobotServer]:
        bus = ZenohBus(Endpoints(listen=(f"tcp/127.0.0.1:{self.port}",)))
        instance = f"{ROOT}/instances/{'1' * 32}"
        inboxes = [
            bus.serve(f"{ROOT}/describe"),
            bus.serve(f"{instance}/open"),
            bus.serve(f"{instance}/sessions/*/control"),
        ]
        observations = bus.subscribe(f"{instance}/sessions/*/obs", keep=4)
        ends = threading.Event()

        def enveloped(asked: dict[str, Any], answer: tuple[str, dict[str, Any]]) -> bytes:
            kept = {k: asked[k] for k in ("instance_id", "session_id", "request_id", "generation")}
            return msgpack.packb({"version": 1, "message_type": answer[0], "body": answer[1], **kept})

        def serve() -> None:
            while not ends.is_set():
                bus.wait(20_000_000)
                for inbox in inboxes:
                    for request in inbox.drain():
                        asked = msgpack.unpackb(request.payload)
                        request.reply(enveloped(asked, self.replied(asked)))
                for sample in observations.drain():
                    asked = msgpack.unpackb(sample.payload)
                    answer = enveloped(asked, self.acted(asked))
                    key = f"{instance}/sessions/{asked['session_id']}/act"
                    bus.publish(key, answer, encoding="", attachment=b"", priority=Priority.DATA)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        try:
            yield self
        finally:
            ends.set()
            thread.join(10)
            bus.close()


@pytest.fixture(scope="module")
def named(mapping: PolicyMapping) -> PolicyMapping:
    return dataclasses.replace(
        mapping,
        prompt=Prompt(key=("task",)),
        cameras=(Camera(camera="front", key=(FRONT,), size_px=(8, 8)), Camera(camera="wrist", key=None)),
        state=(Numbers(key=(STATE,), columns=(0, 1, 2), dims=(0, 1, 2)),),
        actions=(Numbers(key=("action",), columns=(0, 1, 2), dims=(0, 1, 2)),),
    )


PEERS: list[Any] = []


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    yield
    while PEERS:
        PEERS.pop().close()


def engine_of(server: LerobotServer, mapping: PolicyMapping, answer_s: float = 5.0) -> RemoteEngine:
    peer = LerobotPeer(server.url, mapping)
    PEERS.append(peer)
    return RemoteEngine(peer, mapping, server.url, answer_s=answer_s, start_s=5)


def request_of(engine: RemoteEngine, **changes: Any) -> Any:
    return dataclasses.replace(
        example_request(engine.spec, frame_px=8), previous_rows=None, committed_rows=0,
        proprio=np.array([0.1, 0.2, 0.3], np.float32), **changes,
    )  # fmt: skip


def test_the_exchange_is_the_published_one(named: PolicyMapping, episode_info: Callable[..., Any], paper: Any) -> None:
    with LerobotServer().running() as server:
        engine = engine_of(server, named)
        engine.begin(episode_info(paper))
        for instruction in ("pick", "pick", "place"):
            rows = engine.invoke(request_of(engine, instruction=instruction))
            np.testing.assert_allclose(rows, np.tile([0.1, 0.2, 0.3], (20, 1)), rtol=1e-6)
        assert server.calls == ["describe", "open", "reset", "reset"]
        assert server.generation == 1
        assert [each["sequence"] for each in server.seen] == [1, 2, 3, 4]
        versions = [each["task_version"] for each in server.seen]
        assert (versions[1] == versions[2], versions[3] - versions[2]) == (True, 1)
        picture = server.seen[-1]["features"][FRONT]
        assert (picture["__lerobot_type__"], picture["shape"], picture["channel_order"]) == ("rgb", [8, 8, 3], "RGB")
        PEERS.pop().close()
        assert (server.calls[-1], server.is_taken) == ("close", False)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"features": [feature(STATE, (3,), "tensor")]}, "its features are"),
        ({"modes": 3}, "its modes are 3"),
        ({"action_interval": "fast"}, "its action_interval is 'fast'"),
        ({"action_interval": 0}, "its action_interval is 0"),
        (
            {"features": [feature(STATE, (6,), "tensor"), feature(FRONT, (8, 8, 3), "rgb")]},
            r"is \[6\]; test has \(3,\)",
        ),
        ({"execution_steps": 50}, "it answers 50 rows at 20 Hz; test has horizon 20 at 20 Hz"),
        ({"action_interval": 1 / 30}, "rows at 30 Hz"),
        ({"modes": ["rtc_guided"]}, "expected chunk among them"),
        ({"current_observation_only": False}, "its policy reads earlier observations too"),
    ],
)
def test_another_deployment_is_refused_before_anything_moves(
    named: PolicyMapping, change: dict[str, Any], said: str
) -> None:
    server = LerobotServer()
    server.capabilities |= change
    with server.running(), pytest.raises(ValueError, match=said):
        engine_of(server, named)
    assert (server.seen, server.num_sessions) == ([], 0)


def test_an_error_is_told_and_the_next_invocation_opens_another_session(named: PolicyMapping) -> None:
    with LerobotServer().running() as server:
        engine = engine_of(server, named)
        server.script = lambda body: ("error", {"code": "execution", "message": "CUDA out of memory"})
        with pytest.raises(ValueError, match="it says: execution: CUDA out of memory"):
            engine.invoke(request_of(engine))
        server.script = None
        assert engine.invoke(request_of(engine)).shape == (20, 3)
        assert server.num_sessions == 2


@pytest.mark.parametrize("rows", [np.zeros((16, 3), np.float32), np.full((20, 3), np.nan, np.float32)])
def test_other_rows_are_never_played(named: PolicyMapping, rows: np.ndarray) -> None:
    with LerobotServer().running() as server:
        engine = engine_of(server, named)
        server.script = lambda body: ("action", {"canonical_actions": tensor(rows)})
        with pytest.raises(ValueError, match=r"is \(16, 3\)|expected finite numbers"):
            engine.invoke(request_of(engine))


def test_a_late_answer_is_not_the_next_ones(named: PolicyMapping) -> None:
    with LerobotServer().running() as server:
        engine = engine_of(server, named, answer_s=0.5)
        late = ("action", {"canonical_actions": tensor(np.full((20, 3), 9, np.float32))})
        server.script = lambda body: time.sleep(0.7) or late
        with pytest.raises(ValueError, match=r"no answer within 0\.5 s"):
            engine.invoke(request_of(engine))
        server.script = None
        for _ in range(20):  # its close waits behind the late answer
            try:
                rows = engine.invoke(request_of(engine))
                break
            except ValueError:
                time.sleep(0.1)
        np.testing.assert_allclose(rows[0], [0.1, 0.2, 0.3], rtol=1e-6)


def test_a_window_is_refused(named: PolicyMapping) -> None:
    windowed = dataclasses.replace(named, window=ObservationWindow(video_ticks=(-1, 0)))
    with pytest.raises(ValueError, match=r"reads the current observation only; leave \[window\] out"):
        LerobotPeer("tcp/127.0.0.1:7447#arm", windowed)


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("tcp/127.0.0.1:7447", "expected tcp/HOST:PORT#DEPLOYMENT"),
        ("tcp/10.0.0.1:7447#arm", "use a tunnel"),
    ],
)
def test_an_address_that_cannot_be_used_is_told(named: PolicyMapping, url: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        LerobotPeer(url, named)
