"""``python -m protocol.probe``: what counts as there and ready."""

from __future__ import annotations

import pytest

from protocol.bus import LocalBus
from protocol.heartbeat import Heartbeat
from protocol.link import Link
from protocol.messages import ServingState
from protocol.probe import HEALTHY, UNHEALTHY, UNUSABLE, main, trouble
from protocol.topics import alive_key
from protocol.zenoh_bus import Endpoints, ZenohBus
from sim_client.launch import free_ports


@pytest.fixture
def bus() -> LocalBus:
    return LocalBus()


def look(bus: LocalBus, proc: str, within_ns: int = 0) -> str:
    return trouble(Link(bus, robot="r0", proc="probe"), proc, within_ns=within_ns)


def beating(bus: LocalBus, proc: str, state: ServingState) -> None:
    """A process that sends heartbeats whenever others wait."""
    heartbeat = Heartbeat(Link(bus, robot="r0", proc=proc), "1", "host")

    def step() -> bool:
        heartbeat.set(state=state)
        return True

    bus.add_participant(step)


@pytest.mark.parametrize("proc", ["ponder", "pounce", "clock", "sim"])
def test_without_a_token_nobody_is_there(bus: LocalBus, proc: str) -> None:
    assert "no liveliness token" in look(bus, proc)


def test_the_clock_s_token_is_enough(bus: LocalBus) -> None:
    bus.declare_alive(alive_key("r0", "clock"))
    assert look(bus, "clock") == ""


def test_another_robot_s_token_is_not(bus: LocalBus) -> None:
    bus.declare_alive(alive_key("r1", "clock"))
    assert "no liveliness token" in look(bus, "clock")


@pytest.mark.parametrize("proc", ["ponder", "pounce"])
def test_a_server_that_is_alive_but_silent_hangs(bus: LocalBus, proc: str) -> None:
    bus.declare_alive(alive_key("r0", proc))
    assert "hangs" in look(bus, proc, within_ns=1_000_000)


@pytest.mark.parametrize("proc", ["ponder", "pounce"])
def test_a_ready_heartbeat_is_health(bus: LocalBus, proc: str) -> None:
    beating(bus, proc, ServingState.READY)
    assert look(bus, proc, within_ns=1_000_000_000) == ""


@pytest.mark.parametrize("state", [state for state in ServingState if state not in (0, ServingState.READY)])
def test_any_other_heartbeat_is_not(bus: LocalBus, state: ServingState) -> None:
    beating(bus, "pounce", state)
    assert state.name.lower() in look(bus, "pounce", within_ns=5_000_000)


def test_ponder_s_heartbeat_says_nothing_about_pounce(bus: LocalBus) -> None:
    beating(bus, "ponder", ServingState.READY)
    bus.declare_alive(alive_key("r0", "pounce"))
    assert "hangs" in look(bus, "pounce", within_ns=5_000_000)


def test_an_endpoint_open_to_the_network_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["clock", "--link.connect", "tcp/192.0.2.1:7447"]) == UNUSABLE
    assert "not encrypted" in capsys.readouterr().err


@pytest.mark.e2e
def test_over_zenoh_a_process_is_healthy_until_it_leaves(capsys: pytest.CaptureFixture[str]) -> None:
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    arguments = ["clock", "--link.connect", endpoint, "--within-ms", "1000"]
    bus = ZenohBus(Endpoints(listen=(endpoint,)))
    bus.declare_alive(alive_key("r0", "clock"))
    assert main(arguments) == HEALTHY
    bus.close()
    assert main(arguments) == UNHEALTHY
    assert capsys.readouterr().out.splitlines()[0] == "clock is ready"
