"""A model server that cannot start says so in its heartbeat before it ends."""

from __future__ import annotations

import socket

import pytest

from model_server.daemon import serve_model
from protocol import daemon, topics
from protocol.bus import LocalBus
from protocol.errors import TransportError
from protocol.link import Link, Stream
from protocol.messages import Health, ServingState
from protocol.options import DaemonOptions, LinkOptions


class Broken:
    """A server whose kernels do not run on this machine."""

    def warm_up(self) -> None:
        raise RuntimeError("no kernel image is available")

    def ready(self) -> None:
        raise AssertionError("not warm")

    def step(self) -> bool:
        raise AssertionError("not warm")


def unreadable() -> object:
    raise ValueError("not a folder")


@pytest.fixture
def healths(monkeypatch: pytest.MonkeyPatch) -> Stream[Health]:
    bus = LocalBus()
    monkeypatch.setattr(daemon, "open_bus", lambda options: bus)
    monkeypatch.setattr(bus, "close", lambda: None)  # the robot's side outlives the server
    monkeypatch.setattr(daemon, "set_up_logging", lambda options: None)
    return Link(bus, robot="r0", proc="sim").subscribe(topics.HEALTH)


def test_a_checkpoint_that_cannot_be_loaded_is_reported(healths: Stream[Health]) -> None:
    with pytest.raises(ValueError, match="not a folder"):
        serve_model("ponder", LinkOptions(), "random", unreadable, lambda *_: Broken())
    last = healths.drain()[-1]
    assert (last.state, last.detail) == (ServingState.FAILED, "not a folder")


def test_a_warm_up_that_fails_is_reported(healths: Stream[Health]) -> None:
    with pytest.raises(RuntimeError, match="no kernel image"):
        serve_model("ponder", LinkOptions(), "random", object, lambda *_: Broken())
    last = healths.drain()[-1]
    assert (last.state, last.detail) == (ServingState.FAILED, "warm-up: no kernel image is available")


def test_a_taken_metrics_port_is_a_sentence(healths: Stream[Health]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        options = DaemonOptions(metrics=f"127.0.0.1:{taken.getsockname()[1]}")
        with pytest.raises(TransportError, match=f"--metrics {options.metrics}: Address already in use"):
            serve_model("ponder", LinkOptions(), "random", object, lambda *_: Broken(), options)


@pytest.mark.parametrize(("is_shadow", "expected"), [(True, [10]), (False, [])])
def test_a_shadow_alone_steps_back(
    healths: Stream[Health], monkeypatch: pytest.MonkeyPatch, is_shadow: bool, expected: list[int]
) -> None:
    lowered: list[int] = []
    monkeypatch.setattr("os.nice", lowered.append)
    with pytest.raises(ValueError, match="not a folder"):
        serve_model("ponder", LinkOptions(), "random", unreadable, lambda *_: Broken(), is_shadow=is_shadow)
    assert lowered == expected
