"""An openpi policy, unmodified, under our clock: frozen, killed and back, it moves nothing and ends nothing but motion.

Its server is openpi's own class where PP_OPENPI_SERVER names ``openpi/serving/websocket_policy_server.py``, else a
stand-in with the real client's msgpack. The tests of this file share processes and run in order.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clock.check import disagreements
from protocol import messages as m
from sim_client.launch import free_ports

pytestmark = [pytest.mark.e2e, pytest.mark.realtime, pytest.mark.sim, pytest.mark.slow]

MAPPING = Path(__file__).parents[2] / "examples" / "policies" / "openpi_panda.toml"
SERVER = Path(__file__).with_name("openpi_server.py")


class Policy:
    """The policy server's process."""

    def __init__(self) -> None:
        self.port = free_ports(1)[0]
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen([sys.executable, str(SERVER), str(self.port)])

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture(scope="module")
def policy() -> Iterator[Policy]:
    pytest.importorskip("openpi_client", reason="pip install --no-deps openpi-client==0.1.2")
    policy = Policy()
    yield policy
    policy.kill()


@pytest.fixture(scope="module")
def machine(
    policy: Policy, machine_with: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Any]:
    url = f"ws://127.0.0.1:{policy.port}"
    options = ["--backend", "openpi", "--url", url, "--mapping", str(MAPPING), "--answer-s", "0.4"]
    machine = machine_with(tmp_path_factory.mktemp("daemons"), ponder=None, pounce=options)
    yield machine
    machine.end()


def test_its_rows_are_played_and_without_it_the_robot_holds_slows_down_and_stops(
    machine: Any, policy: Policy, tmp_path: Path
) -> None:
    player = machine.play(tmp_path, "--ponder", "none", "--max-steps", "400")
    player.wait_for_tick(15)
    policy.process.send_signal(19)  # SIGSTOP
    player.wait_for_level(m.Level.HOLD)
    policy.process.send_signal(18)  # SIGCONT
    player.wait_for_level(m.Level.PLAY)
    policy.kill()
    episode = player.wait_for_end()
    assert next(disagreements(episode.record), None) is None
    kept = [
        tick.level for tick in episode.record.ticks if tick.level != m.Level.SKIPPED
    ]  # a busy machine leaves some out
    levels = [level.name for level, _ in groupby(kept)]
    assert levels[:2] == ["PLAY", "HOLD"]
    assert levels[-4:] == ["PLAY", "HOLD", "DECELERATE", "STOPPED"]
    assert "stopped by the ladder" in episode.result["reason"]
    refused = [event.text for event in episode.record.events if event.name == "invocation_refused"]
    assert any("no answer within 0.4 s" in text for text in refused)
    assert any("refused" in text.lower() or "connection lost" in text for text in refused)
    state = np.array([tick.state for tick in episode.record.ticks if tick.level == m.Level.STOPPED])
    assert np.abs(np.diff(state[-20:], axis=0)).max() < 1e-3


def test_a_policy_that_came_back_plays_the_next_episode(machine: Any, policy: Policy, tmp_path: Path) -> None:
    policy.start()
    episode = machine.play(tmp_path, "--ponder", "none", "--max-steps", "25").wait_for_end()
    assert next(disagreements(episode.record), None) is None
    assert episode.result["steps"] == 25
    assert {tick.level for tick in episode.record.ticks} <= {m.Level.PLAY, m.Level.SKIPPED}
