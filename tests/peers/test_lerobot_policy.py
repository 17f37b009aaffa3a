"""Our policy plug-in beside LeRobot itself: discovered, made, played by its evaluation loop. `make peers` runs this.

LEROBOT_PYTHON: a Python that has lerobot 0.6, msgpack and websockets (Makefile).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from clock.check import disagreements
from protocol.mcap_log import read_log
from sim_client.launch import free_ports

pytestmark = [pytest.mark.peers, pytest.mark.e2e]

SCRIPT = Path(__file__).with_name("lerobot_policy.py")
PLUGIN = Path(__file__).parents[2] / "integrations" / "lerobot_policy_ponderpounce"
PATIENCE_S = 180.0


@pytest.fixture(scope="module")
def python() -> str:
    found = os.environ.get("LEROBOT_PYTHON")
    if not found:
        pytest.skip("LEROBOT_PYTHON is not set; make peers sets it")
    return found


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    """A gateway with servers of its own, tiny and untrained: its url and its folder of logs."""
    out, port = tmp_path_factory.mktemp("gateway"), free_ports(1)[0]
    command = [sys.executable, "-m", "sim_client.gateway", "--dialect", "openpi", "--local", "--out", str(out)]
    with (out / "log").open("wb") as log:
        process = subprocess.Popen([*command, "--listen", f"127.0.0.1:{port}"], stdout=log, stderr=log)
    end_s = time.monotonic() + PATIENCE_S
    while " ready " not in (out / "log").read_text():
        assert process.poll() is None, (out / "log").read_text()
        assert time.monotonic() < end_s, (out / "log").read_text()
        time.sleep(0.1)  # another process's log: there is nothing to wait on
    try:
        yield f"ws://127.0.0.1:{port}", out
    finally:
        process.terminate()
        process.wait(60)


def test_lerobot_s_evaluation_plays_our_rows(python: str, gateway: tuple[str, Path], tmp_path: Path) -> None:
    url, out = gateway
    outside = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"HF_HUB_OFFLINE": "1"}

    def run(*command: str, path: str = "") -> str:
        environment = outside | {
            "PYTHONPATH": os.pathsep.join(filter(None, [path, os.environ.get("LEROBOT_EXTRA", "")]))
        }
        done = subprocess.run([python, *command], capture_output=True, text=True, env=environment, check=False)
        assert done.returncode == 0, done.stderr[-3000:]
        return done.stdout

    site, folder = str(tmp_path / "site"), str(tmp_path / "policy")
    run("-m", "pip", "install", "--quiet", "--no-deps", "--target", site, str(PLUGIN))
    run("-m", "lerobot_policy_ponderpounce", folder, path=site)
    assert sorted(path.name for path in Path(folder).iterdir()) == [
        "config.json", "policy_postprocessor.json", "policy_preprocessor.json",
    ]  # fmt: skip
    told = json.loads(run(str(SCRIPT), url, folder, path=site).splitlines()[-1])
    assert (told["type"], told["class"]) == ("ponderpounce", "PonderpouncePolicy")
    actions = np.array(told["actions"])
    assert actions.shape == (2, 1, 5, 8)  # episodes, environments, steps, commands
    end_s = time.monotonic() + PATIENCE_S
    while (out / "log").read_text().count(" over ") < 2:  # the second episode ends as the client leaves
        assert time.monotonic() < end_s, (out / "log").read_text()
        time.sleep(0.1)
    logs = sorted((read_log(path) for path in out.rglob("*.mcap")), key=lambda log: log.info.header.epoch)
    assert [log.info.instruction for log in logs] == ["pick the cube"] * 2
    for log, played in zip(logs, actions, strict=True):
        assert next(disagreements(log), None) is None
        sent = np.stack([action.values for action in log.actions])
        assert sent.tolist() == played[0].astype(np.float32).tolist()
