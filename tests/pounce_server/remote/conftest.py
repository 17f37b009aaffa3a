"""A policy server of each wire, scripted, with the peers' own packages where there are any."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection, serve

from protocol.peers.mapping import Camera, Numbers, PolicyMapping, Prompt

HORIZON, DIM = 20, 3
MAPPING = PolicyMapping(
    name="test",
    rate_hz=20,
    play_hz=20,
    horizon=HORIZON,
    num_proprio=DIM,
    num_commands=DIM,
    prompt=Prompt(key=("prompt",)),
    cameras=(Camera(camera="front", key=("image",)), Camera(camera="wrist", key=("wrist_image",))),
    state=(Numbers(key=("state",), columns=(0, 1, 2), dims=(0, 1, 2)),),
    actions=(Numbers(key=("actions",), columns=(0, 1, 2), dims=(0, 1, 2)),),
)


@dataclass
class Policy:
    """What a scripted server answers: its state held, until a test says otherwise."""

    seen: list[dict[str, Any]] = field(default_factory=list)
    script: Callable[[dict[str, Any]], Any] | None = None

    def infer(self, observation: dict[str, Any]) -> Any:
        self.seen.append(observation)
        return self.script(observation) if self.script else {"actions": self.held(observation)}

    @staticmethod
    def held(observation: dict[str, Any]) -> np.ndarray:
        return np.tile(np.asarray(observation["state"], np.float32).ravel(), (HORIZON, 1))


@dataclass
class OpenpiServer:
    """Greets with metadata, answers observations, and says an error as a text frame, as openpi's own server does."""

    policy: Policy = field(default_factory=Policy)
    metadata: dict[str, Any] = field(default_factory=dict)
    connections: list[ServerConnection] = field(default_factory=list)
    port: int = 0

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    def converse(self, connection: ServerConnection) -> None:
        from openpi_client import msgpack_numpy as theirs

        self.connections.append(connection)
        try:
            connection.send(theirs.packb(self.metadata))
            while True:
                answer = self.policy.infer(theirs.unpackb(connection.recv()))
                connection.send(answer if isinstance(answer, str | bytes) else theirs.packb(answer))
        except ConnectionClosed:
            pass

    @contextmanager
    def running(self, port: int = 0) -> Iterator[None]:
        server: Server = serve(self.converse, "127.0.0.1", port, compression=None, max_size=None)
        self.port = server.socket.getsockname()[1]
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield
        finally:
            for connection in self.connections:
                connection.close_socket()
            server.shutdown()
            thread.join(5)


@pytest.fixture(scope="session")
def mapping() -> PolicyMapping:
    return MAPPING


@pytest.fixture
def openpi_server() -> Iterator[OpenpiServer]:
    pytest.importorskip("openpi_client.msgpack_numpy", reason="pip install --no-deps openpi-client==0.1.2")
    server = OpenpiServer()
    with server.running():
        yield server


@pytest.fixture(scope="session")
def eventually() -> Callable[[Callable[[], bool]], None]:
    def wait(holds: Callable[[], bool]) -> None:
        end_s = time.monotonic() + 10
        while not holds():
            assert time.monotonic() < end_s
            time.sleep(0.01)

    return wait
