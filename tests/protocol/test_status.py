"""``/metrics``, ``/healthz`` and ``/readyz`` over real HTTP, and the addresses that are refused."""

from __future__ import annotations

import logging
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest
from prometheus_client.parser import text_string_to_metric_families

from protocol.bus import LocalBus
from protocol.errors import TransportError
from protocol.link import Link
from protocol.messages import Health, ServingState
from protocol.metrics import End, Metrics
from protocol.options import OperationsOptions
from protocol.status import address_of, status_of
from sim_client.launch import free_ports


class Process:
    """A process whose state a test may change."""

    def __init__(self) -> None:
        self.options = OperationsOptions(metrics=f"127.0.0.1:{free_ports(1)[0]}")
        self.health = Health(state=ServingState.READY)
        self.is_draining = False
        self.silent_ns = 0
        self.metrics = Metrics()

    def watch(self) -> None:
        link = Link(LocalBus(), robot="r0", proc="ponder")
        self.metrics.watch(End(link=link, health=lambda: self.health, silent_ns=lambda: self.silent_ns))

    def get(self, path: str) -> tuple[int, str]:
        try:
            with urllib.request.urlopen(f"http://{self.options.metrics}{path}", timeout=5) as reply:
                return reply.status, reply.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read().decode()


@pytest.fixture
def process() -> Iterator[Process]:
    process = Process()
    with status_of(process.metrics, process.options, lambda: process.is_draining):
        yield process


def test_metrics_are_readable_for_prometheus(process: Process) -> None:
    process.watch()
    status, text = process.get("/metrics")
    assert status == 200
    assert "ponderpounce_ready" in {family.name for family in text_string_to_metric_families(text)}


def test_before_anything_is_watched_it_is_healthy_and_not_ready(process: Process) -> None:
    assert process.get("/healthz") == (200, "ok\n")
    assert process.get("/readyz") == (503, "starting\n")


def test_a_loading_server_is_healthy_and_not_ready(process: Process) -> None:
    process.watch()
    process.health = Health(state=ServingState.LOADING, detail="weights")
    assert process.get("/healthz")[0] == 200
    assert process.get("/readyz") == (503, "ponder of r0 is not ready: loading (0%) weights\n")


def test_a_hung_server_is_not_healthy(process: Process) -> None:
    process.watch()
    process.silent_ns = 12_000_000_000
    assert process.get("/healthz") == (503, "ponder of r0: its loop is silent for 12 s, limit 10 s\n")


def test_a_draining_server_is_healthy_and_not_ready(process: Process) -> None:
    process.watch()
    assert process.get("/readyz") == (200, "ok\n")
    process.is_draining = True
    assert process.get("/readyz") == (503, "draining: no more episodes are opened here\n")
    assert process.get("/healthz")[0] == 200


def test_another_path_is_named(process: Process) -> None:
    assert process.get("/") == (404, "expected /metrics, /healthz or /readyz\n")


def test_a_taken_port_is_a_sentence(process: Process) -> None:
    with (
        pytest.raises(TransportError, match=r"--metrics 127\.0\.0\.1:.*already in use.*a port of its own"),
        status_of(Metrics(), process.options),
    ):
        pass


def test_without_the_option_nothing_is_opened(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with status_of(Metrics(), OperationsOptions()):
        assert "status" not in caplog.text


@pytest.mark.parametrize("address", ["0.0.0.0:9448", "192.0.2.1:9448", "robot.example:9448"])
def test_other_hosts_are_let_in_only_if_the_user_says_so(address: str) -> None:
    with pytest.raises(TransportError, match="say --metrics-open-to-anyone"):
        address_of(OperationsOptions(metrics=address))
    assert address_of(OperationsOptions(metrics=address, metrics_open_to_anyone=True))[1] == 9448


@pytest.mark.parametrize("address", ["9448", ":9448", "127.0.0.1", "127.0.0.1:http", "127.0.0.1:99999"])
def test_an_address_that_is_none_is_refused_with_an_example(address: str) -> None:
    with pytest.raises(TransportError, match=r"expected HOST:PORT, e\.g\. 127"):
        address_of(OperationsOptions(metrics=address))
