"""A chat model plans, an openpi policy acts, neither is ours or changed: they reach a task's first subgoal together.

The policy is a demonstration behind openpi's wire: of the states that the task's own script passed under the subgoal in
its prompt it takes the nearest to the measured one, and answers the rows that came after it. Other prompts it answers
by staying where it is. The chat model is a script as well; everything between them is the shipped programs.
`make peers` runs this; PP_OPENPI_SERVER names openpi's own server, as in `test_policy_server`.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clock.check import disagreements
from protocol import messages as m
from sim_client.launch import free_ports

pytestmark = [pytest.mark.peers, pytest.mark.e2e, pytest.mark.sim, pytest.mark.slow]

EXAMPLES = Path(__file__).parents[2] / "examples"
PATIENCE_S = 300.0  # simulated time waits for everybody
PRESS = "press the button"
SCENE = ["--difficulty", "easy", "--max-steps", "140", "--record-hz", "1"]
SERVER = Path(__file__).with_name("openpi_server.py")


@pytest.fixture(scope="module")
def chat() -> Iterator[str]:
    """A chat endpoint's URL."""
    message = {"role": "assistant", "content": json.dumps({"subgoal": PRESS})}
    body = json.dumps({"choices": [{"index": 0, "message": message, "finish_reason": "stop"}]}).encode()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *given: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}/v1"
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def policy(
    run_module: Callable[..., Any], episode_in: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[str]:
    """A policy server's URL."""
    pytest.importorskip("openpi_client", reason="pip install --no-deps openpi-client==0.1.2")
    folder = tmp_path_factory.mktemp("shown")
    run_module("sim_client", "--policy", "oracle", "--no-progress", "--out", str(folder), *SCENE)
    record = episode_in(folder).record
    changes = [subgoal.tick for subgoal in record.subgoals if subgoal.kind == m.SubgoalKind.TASK_SIMPLE]
    pressed = record.ticks[: changes[1]]
    states, rows = np.stack([tick.state for tick in pressed]), np.stack([tick.action for tick in pressed])
    np.savez(folder / "shown.npz", states=states, rows=rows)
    port = free_ports(1)[0]
    process = subprocess.Popen([sys.executable, str(SERVER), str(port), str(folder / "shown.npz")])
    yield f"ws://127.0.0.1:{port}"
    process.kill()
    process.wait()


@pytest.fixture(scope="module")
def machine(
    chat: str, policy: str, machine_with: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Any]:
    ponder = ["--backend", "openai", "--url", chat, "--model", "scripted", "--ask", str(EXAMPLES / "ask.toml")]
    mapping = str(EXAMPLES / "policies" / "openpi_panda.toml")
    pounce = ["--backend", "openpi", "--url", policy, "--mapping", mapping]
    machine = machine_with(tmp_path_factory.mktemp("daemons"), ponder=ponder, pounce=pounce)
    yield machine
    machine.end()


def test_together_they_reach_the_first_subgoal(machine: Any, episode_in: Callable[..., Any], tmp_path: Path) -> None:
    lockstep = ["--mode", "lockstep", "--clock", "daemon", "--invoke-every-ticks", "10"]
    player = machine.play(tmp_path, *lockstep, *SCENE)
    player.wait_for("the end", lambda: player.process.poll() is not None, patience_s=PATIENCE_S)
    episode = episode_in(tmp_path)
    record = episode.record
    assert next(disagreements(record), None) is None
    goals = [subgoal.text for subgoal in record.subgoals if subgoal.kind == m.SubgoalKind.TASK_SIMPLE]
    assert goals[0] == PRESS
    assert len(goals) > 1, f"the button was not pressed in {episode.result['steps']} steps"
    told = [invocation for invocation in record.invocations if invocation.text]
    assert {invocation.text for invocation in told} == {PRESS}
    assert all(invocation.text_age_ns > 0 for invocation in told)
    assert told[-1].text_age_ns > 1_000_000_000  # the log says how long it has been in force
