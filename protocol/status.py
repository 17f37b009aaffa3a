"""``/metrics``, ``/healthz`` and ``/readyz`` of a process over HTTP, from threads that touch neither bus nor engine."""

from __future__ import annotations

import ipaddress
import logging
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import ThreadingHTTPServer
from typing import Any

from prometheus_client import MetricsHandler

from protocol.errors import TransportError
from protocol.metrics import Metrics
from protocol.options import OperationsOptions

log = logging.getLogger(__name__)

_SILENT_S = 10.0  # a client that sends nothing does not keep its thread
_SWITCH_S = 5e-4  # a scrape keeps the loop from the interpreter for that long, where Python's default is 5 ms
_POLL_S = 0.1  # the longest that the process waits for the server when it leaves


@contextmanager
def status_of(
    metrics: Metrics, options: OperationsOptions, is_draining: Callable[[], bool] = lambda: False
) -> Iterator[None]:
    """Answers at ``--metrics`` for as long as the block lasts; without the option nothing is opened.

    Raises:
        TransportError: the address is not HOST:PORT, is taken, or can be reached from other hosts unasked.
    """
    if options.metrics is None:
        yield
        return
    server = _Server(address_of(options), metrics, is_draining)
    sys.setswitchinterval(_SWITCH_S)
    thread = threading.Thread(target=server.serve_forever, args=(_POLL_S,), name="status", daemon=True)
    thread.start()
    log.info("status listen=%s port=%d", *server.server_address[:2])
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()


def address_of(options: OperationsOptions) -> tuple[str, int]:
    """Host and port of ``--metrics``.

    Raises:
        TransportError: it is not HOST:PORT, or is open to other hosts without --metrics-open-to-anyone.
    """
    host, _, port = (options.metrics or "").rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise TransportError(f"--metrics {options.metrics!r}: expected HOST:PORT, e.g. 127.0.0.1:9448")
    if not options.metrics_open_to_anyone and not _is_loopback(host):
        raise TransportError(
            f"--metrics {options.metrics} can be reached from other hosts: use 127.0.0.1, or say "
            "--metrics-open-to-anyone"
        )
    return host, int(port)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, address: tuple[str, int], metrics: Metrics, is_draining: Callable[[], bool]) -> None:
        self.metrics, self.is_draining = metrics, is_draining
        try:
            super().__init__(address, _Handler.factory(metrics))
        except OSError as error:
            where = f"{address[0]}:{address[1]}"
            raise TransportError(
                f"--metrics {where}: {error.strerror}. Each process needs a port of its own; is another one there?"
            ) from None

    def handle_error(self, request: Any, client_address: Any) -> None:
        log.debug("status client=%s went away", client_address, exc_info=True)


class _Handler(MetricsHandler):
    timeout = _SILENT_S
    server: _Server

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        ends = self.server.metrics.ends
        if path == "/metrics":
            super().do_GET()
        elif path == "/healthz":
            self._say([end.hang for end in ends])
        elif path == "/readyz":
            draining = "draining: no more episodes are opened here" if self.server.is_draining() else ""
            self._say([draining, *(end.unready for end in ends)] if ends else ["starting"])
        else:
            self._say(["expected /metrics, /healthz or /readyz"], HTTPStatus.NOT_FOUND)

    def _say(self, troubles: list[str], failed: HTTPStatus = HTTPStatus.SERVICE_UNAVAILABLE) -> None:
        """Answers 200 if there is no trouble; else ``failed``, with one trouble a line."""
        lines = [trouble for trouble in troubles if trouble]
        body = ("\n".join(lines or ["ok"]) + "\n").encode()
        self.send_response(failed if lines else HTTPStatus.OK)
        self.send_header("Content-Type", "text/plain; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)
