"""What ``clock-serve`` tells its operators: which model it waits for, whose models it plays, and a taken port."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any

import pytest

from clock.__main__ import main
from clock.status import end_of
from protocol import messages as m


def test_it_is_ready_when_both_models_are(rig: Any) -> None:
    end = end_of(rig.clock, rig.links["clock"], lambda: 0)
    rig.ponder.heartbeat.set(state=m.ServingState.WARMING, progress=0.5)
    rig.settle()
    assert end.unready == "clock of r0 is not ready: ponder is warming (50%)"
    rig.ponder.heartbeat.set(state=m.ServingState.READY)
    rig.settle()
    assert end.unready == ""


def test_its_series_are_of_the_newest_episode_s_models(
    rig: Any, episode_info: Callable[..., m.EpisodeInfo], paper: m.Schedule
) -> None:
    end = end_of(rig.clock, rig.links["clock"], lambda: 0)
    assert end.identity[:3] == ("clock", "r0", "")
    rig.enter(episode_info(paper))
    assert end.identity[:3] == ("clock", "r0", "fake-ponder+fake-pounce")


def test_it_may_wait_for_a_demonstration_to_be_read(rig: Any) -> None:
    assert end_of(rig.clock, rig.links["clock"], lambda: 120_000_000_000).hang == ""
    assert end_of(rig.clock, rig.links["clock"], lambda: 241_000_000_000).hang


def test_a_taken_metrics_port_is_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        assert main(["--metrics", address]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"clock-serve: --metrics {address}: Address already in")
