"""The real openpi-client drives the gateway, which drives the real daemons; a table of ours is the client's world."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clock.check import disagreements
from dual_system.tasks.environment import make_environment
from protocol import messages as m
from protocol.mcap_log import read_log
from protocol.process import ENDING_S
from sim_client.launch import free_ports

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.sim,
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:connect.. must be used as a context:DeprecationWarning"),  # openpi-client's
]

NUM_REQUESTS, NUM_ROWS = 3, 10
PATIENCE_S = 90.0


class Gateway:
    """``pp-gateway`` with servers of its own."""

    def __init__(self, out: Path, *arguments: str) -> None:
        self.port, self.log = free_ports(1)[0], out / "gateway.log"
        command = [sys.executable, "-m", "sim_client.gateway", "--local", "--out", str(out)]
        command += ["--listen", f"127.0.0.1:{self.port}", *arguments]
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log)
        self._wait_for(" ready ")

    def _wait_for(self, text: str) -> None:
        deadline_s = time.monotonic() + PATIENCE_S
        while text not in self.log.read_text():
            if self.process.poll() is not None or time.monotonic() > deadline_s:
                pytest.fail(f"the gateway said no {text!r}: {self.log.read_text()}")
            time.sleep(0.05)  # another process's log: there is nothing to wait on

    def stop(self) -> int:
        self.process.terminate()
        return self.process.wait(2 * ENDING_S)


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[list[dict[str, Any]], Path, int]]:
    """The answers that the client got, the folder of the gateway, and the code with which it left."""
    client_module = pytest.importorskip(
        "openpi_client.websocket_client_policy", reason="pip install --no-deps openpi-client==0.1.2"
    )
    out = tmp_path_factory.mktemp("gateway")
    gateway = Gateway(out, "--dialect", "openpi", "--rows", str(NUM_ROWS), "--ponder", "none")
    client = client_module.WebsocketClientPolicy("127.0.0.1", gateway.port)
    try:
        answers = []
        with make_environment("PickHighlight") as environment:
            seen = environment.reset(0)
            for _ in range(NUM_REQUESTS):
                answers.append(
                    client.infer(
                        {
                            "observation/image": seen.frames["front"],
                            "observation/wrist_image": seen.frames["wrist"],
                            "observation/state": seen.state,
                            "prompt": environment.instruction,
                        }
                    )
                )
                for row in answers[-1]["actions"]:
                    seen = environment.step(row)
            with pytest.raises(RuntimeError, match="expected 'prompt'"):
                client.infer({"observation/state": seen.state})
        yield answers, out, gateway.stop()
    finally:
        client._ws.close()
        gateway.process.kill()
        gateway.process.wait()


def test_every_request_is_answered_with_a_chunk(episode: Any) -> None:
    answers, _, _ = episode
    assert [answer["tick"] for answer in answers] == [NUM_ROWS * request for request in range(NUM_REQUESTS)]
    for answer in answers:
        assert answer["actions"].shape == (NUM_ROWS, 8)
        assert answer["levels"] == ["PLAY"] * NUM_ROWS
        assert np.isfinite(answer["actions"]).all()


def test_the_log_follows_from_itself_and_holds_what_the_client_played(episode: Any) -> None:
    answers, out, code = episode
    assert code == 0
    (path,) = out.rglob("*.mcap")
    record = read_log(path)
    assert not record.recovered
    assert next(disagreements(record), None) is None
    played = np.concatenate([answer["actions"] for answer in answers])
    sent = np.stack([action.values for action in record.actions])
    assert len(sent) == NUM_ROWS * (NUM_REQUESTS - 1) + 1
    assert sent.tobytes() == played[: len(sent)].tobytes()
    assert record.result is not None
    assert record.result.status == m.TaskStatus.ABORTED  # the gateway was stopped while the client was connected


@pytest.mark.acceptance
def test_clients_on_one_port_play_side_by_side_on_one_pair_of_servers(tmp_path: Path) -> None:
    """Whoever sits beside them, equal requests get equal rows: batches change the last bits only."""
    client_module = pytest.importorskip("openpi_client.websocket_client_policy")
    gateway = Gateway(tmp_path, "--dialect", "openpi", "--seats", "2", "--rows", str(NUM_ROWS))
    clients = [client_module.WebsocketClientPolicy("127.0.0.1", gateway.port) for _ in range(3)]

    def ask(client: Any, shade: int) -> Any:
        picture = np.full((256, 256, 3), shade, np.uint8)
        return client.infer(
            {
                "observation/image": picture,
                "observation/wrist_image": picture,
                "observation/state": np.array([0, 0, 0, -1.5, 0, 1.8, 0, 0.04], np.float32),
                "prompt": "pick the cube",
            }
        )["actions"]

    try:
        rows: list[list[np.ndarray]] = [[], []]
        for shade in range(3):
            threads = [
                threading.Thread(target=lambda one=one, shade=shade: rows[one].append(ask(clients[one], shade)))
                for one in range(2)
            ]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(PATIENCE_S)
        with pytest.raises(RuntimeError, match="all 2 seats are taken"):
            ask(clients[2], 0)
        np.testing.assert_allclose(np.concatenate(rows[0]), np.concatenate(rows[1]), rtol=0, atol=1e-4)
        clients[0]._ws.close()
        deadline_s = time.monotonic() + PATIENCE_S
        while "client left" not in gateway.log.read_text():
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        assert ask(clients[2], 0).shape == (NUM_ROWS, 8)
        assert gateway.stop() == 0
        logs = list(tmp_path.rglob("*.mcap"))
        assert len(logs) == 3
        assert {read_log(path).info.header.robot for path in logs} == {"r0", "r0-1"}
        assert [next(disagreements(read_log(path)), None) for path in logs] == [None] * 3
    finally:
        for client in clients:
            client._ws.close()
        gateway.process.kill()
        gateway.process.wait()
