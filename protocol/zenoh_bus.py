"""The bus over zenoh; the only file that imports zenoh.

Peers have explicit endpoints, no multicast and no gossip. Endpoints are Unix sockets by default, in a folder of one
user's; one that other hosts can reach is refused without TLS. Shared memory is on: zenoh sends raw frames between
processes of one host through it. The lease is 500 ms (default: 10 s): a frozen peer's token is gone in
half a second.
"""

from __future__ import annotations

import ipaddress
import json
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import zenoh

from protocol.access import access_control
from protocol.bus import Bell, Inbox, Request, Sample, Subscription, anybody
from protocol.errors import CallFailed, TransportError
from protocol.memory import keep_freed_memory
from protocol.options import LinkOptions
from protocol.sockets import make_private, socket_path
from protocol.tls import Tls, check_files
from protocol.topics import Priority

LEASE_MS = 500
_PRIORITIES = {
    Priority.REAL_TIME: zenoh.Priority.REAL_TIME,
    Priority.INTERACTIVE_HIGH: zenoh.Priority.INTERACTIVE_HIGH,
    Priority.DATA_HIGH: zenoh.Priority.DATA_HIGH,
    Priority.DATA: zenoh.Priority.DATA,
    Priority.BACKGROUND: zenoh.Priority.BACKGROUND,
}
_QUEUES = ("control", "real_time", "interactive_high", "interactive_low", "data_high", "data", "data_low", "background")
_MAX_PUBLISHERS = 256
_RUNTIME_VARIABLE = "ZENOH_RUNTIME"
_ONE_RUNTIME = (
    "(" + ", ".join(f"{n}: (handover: app)" for n in ("rx", "tx", "net", "acc")) + ", app: (worker_threads: 2))"
)
"""Zenoh's threads: two for all work instead of six that wake each other; a fifth less time per message (measured)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Endpoints:
    """Endpoints to listen on and to connect to, in zenoh's form: ``unixsock-stream/PATH`` or ``tcp/127.0.0.1:7448``."""

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    tls: Tls | None = None
    shared_memory: bool = False
    """Whether raw frames pass through zenoh's shared memory, as bus_latency measures it; no daemon does that.

    zenoh 1.10 never unmaps what a peer that left had shared, 17 MB a robot's process (its issue 2787), locks what it
    maps, which ordinary users may not, and drops what a reader cannot map without a word (2788).
    """
    lease_ms: int = LEASE_MS

    def __post_init__(self) -> None:
        for endpoint in (*self.listen, *self.connect):
            if not is_loopback(endpoint) and not (endpoint.startswith(("tls/", "quic/")) and self.tls):
                raise TransportError(
                    f"endpoint {endpoint} can be reached from other hosts and is not encrypted. "
                    "Use a loopback address, or tls/HOST:PORT with --link.tls-ca, --link.tls-certificate and "
                    "--link.tls-key."
                )

    @property
    def are_local(self) -> bool:
        return all(is_loopback(e) for e in (*self.listen, *self.connect))


def is_loopback(endpoint: str) -> bool:
    """Whether only this host can use ``endpoint``.

    Raises:
        TransportError: it is not of the form ``PROTOCOL/ADDRESS``.
    """
    _, slash, address = endpoint.partition("/")
    if not slash or not address:
        raise TransportError(f"endpoint {endpoint!r}: expected PROTOCOL/ADDRESS, for example tcp/127.0.0.1:7447")
    if socket_path(endpoint):
        return True
    host = address.split("?")[0].split("#")[0].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def zenoh_config(endpoints: Endpoints) -> zenoh.Config:
    settings: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": list(endpoints.listen),
        "connect/endpoints": list(endpoints.connect),
        "connect/timeout_ms": -1,  # with the next line: keep trying in the background; 0 would try once
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 400, "period_increase_factor": 2},
        "transport/link/tx/lease": endpoints.lease_ms,
        "transport/link/tx/keep_alive": 5,
        # Sixteen batches per class, the maximum; the default is two. A raw observation takes seven, and the clock's
        # poll sends several small messages at once: on a busy host the third would be dropped after 1 ms.
        **{f"transport/link/tx/queue/size/{name}": 16 for name in _QUEUES},
        "transport/shared_memory/enabled": endpoints.shared_memory and endpoints.are_local,
    }
    if endpoints.tls:
        tls = endpoints.tls
        settings |= {
            "transport/link/tls/root_ca_certificate": str(tls.ca),
            "transport/link/tls/enable_mtls": True,
            "transport/link/tls/listen_certificate": str(tls.certificate),
            "transport/link/tls/listen_private_key": str(tls.key),
            "transport/link/tls/connect_certificate": str(tls.certificate),
            "transport/link/tls/connect_private_key": str(tls.key),
            "access_control": access_control(),
        }
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config


class ZenohBus:
    """``Bus`` over one zenoh session.

    Zenoh's threads only append to rings and ring the bell; the owner of the bus drains and works in its own thread.

    Raises:
        TransportError: the TLS files do not fit, or the listen endpoint is taken, cannot be opened, or is a socket
            that other users can reach.
    """

    def __init__(self, endpoints: Endpoints) -> None:
        os.environ.setdefault(_RUNTIME_VARIABLE, _ONE_RUNTIME)  # zenoh's only way to set it; read once per process
        zenoh.init_log_from_env_or("error")
        keep_freed_memory()
        if endpoints.tls is not None:
            check_files(endpoints.tls)
        for socket in filter(None, map(socket_path, (*endpoints.listen, *endpoints.connect))):
            make_private(socket)
        try:
            self._session = zenoh.open(zenoh_config(endpoints))
        except zenoh.ZError as error:
            where = ", ".join(endpoints.listen) or "no listen endpoint"
            raise TransportError(f"zenoh does not open ({where}): {error}. Is another one there?") from None
        self.is_local = endpoints.are_local
        self._bell = Bell()
        self._publishers: dict[str, Any] = {}
        self._declared: list[Any] = []  # zenoh undeclares handles that are garbage-collected

    def publish(self, key: str, payload: bytes, *, encoding: str, attachment: bytes, priority: Priority) -> None:
        publisher = self._publishers.get(key)
        if publisher is None:
            if len(self._publishers) >= _MAX_PUBLISHERS:  # keys contain episodes: drop the oldest
                self._publishers.pop(next(iter(self._publishers))).undeclare()
            publisher = self._session.declare_publisher(
                key,
                encoding=zenoh.Encoding(encoding),
                priority=_PRIORITIES[priority],
                congestion_control=zenoh.CongestionControl.DROP,
                express=True,
            )
            self._publishers[key] = publisher
        publisher.put(payload, attachment=attachment)

    def subscribe(self, expression: str, *, keep: int, is_expected: Callable[[bytes], bool] = anybody) -> Subscription:
        subscription = Subscription(keep, is_expected)

        def arrived(sample: zenoh.Sample) -> None:
            attachment = _attachment(sample)
            subscription.put(lambda: _copy(sample, attachment), attachment)
            self._bell.ring()

        self._declared.append(self._session.declare_subscriber(expression, arrived))
        return subscription

    def serve(self, key: str) -> Inbox:
        inbox = Inbox()

        def asked(query: zenoh.Query) -> None:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            inbox.put(Request(payload, _replier(query)))
            self._bell.ring()

        self._declared.append(self._session.declare_queryable(key, asked, complete=True))
        return inbox

    def call(self, key: str, payload: bytes, *, timeout_ns: int) -> bytes:
        timeout_ms = timeout_ns / 1e6
        why, start_ns = "nobody serves it (is the process up, are the endpoints right?)", time.monotonic_ns()
        for reply in self._session.get(key, payload=payload, timeout=timeout_ns / 1e9):
            if reply.ok is not None:
                return bytes(reply.ok.payload.to_bytes())
            why = reply.err.payload.to_string() if reply.err is not None else why
        if time.monotonic_ns() - start_ns >= timeout_ns:  # for an absent server zenoh gives no reply, and at once
            why = "it is served, and the reply did not come in time"
        raise CallFailed(key, timeout_ms, why)

    def ask(self, key: str, payload: bytes, *, timeout_ns: int) -> Future[bytes]:
        future: Future[bytes] = Future()

        def wait() -> None:
            try:
                future.set_result(self.call(key, payload, timeout_ns=timeout_ns))
            except Exception as error:  # besides CallFailed: the session was closed meanwhile
                why = str(error) or type(error).__name__
                future.set_exception(error if isinstance(error, CallFailed) else CallFailed(key, timeout_ns / 1e6, why))
            self._bell.ring()

        threading.Thread(target=wait, name="zenoh-ask", daemon=True).start()
        return future

    def declare_alive(self, key: str) -> None:
        self._declared.append(self._session.liveliness().declare_token(key))

    def watch_alive(self, expression: str) -> Subscription:
        subscription = Subscription(64)

        def changed(sample: zenoh.Sample) -> None:
            key, payload = str(sample.key_expr), b"1" if sample.kind == zenoh.SampleKind.PUT else b""
            subscription.put(lambda: Sample(key, payload, "", b""))
            self._bell.ring()

        watcher = self._session.liveliness().declare_subscriber(expression, changed, history=True)
        self._declared.append(watcher)
        return subscription

    def wait(self, timeout_ns: int) -> None:
        self._bell.wait(timeout_ns)

    def ring(self) -> None:
        self._bell.ring()

    def close(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call, unused-ignore]


def _attachment(sample: zenoh.Sample) -> bytes:
    return sample.attachment.to_bytes() if sample.attachment is not None else b""


def _copy(sample: zenoh.Sample, attachment: bytes) -> Sample:
    return Sample(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding), attachment)


def _replier(query: zenoh.Query) -> Callable[[bytes], None]:
    def reply(payload: bytes) -> None:
        query.reply(query.key_expr, payload)  # of the question: what is served may have wildcards
        query.drop()  # the caller waits for the end of the replies, not for the first

    return reply


def open_bus(options: LinkOptions) -> ZenohBus:
    """The bus that a daemon's options describe.

    Raises:
        TransportError: an endpoint is taken, malformed, or open to the network without TLS.
    """
    files = options.tls_files()
    tls = Tls(ca=files[0], certificate=files[1], key=files[2]) if files else None
    return ZenohBus(Endpoints(listen=options.listen, connect=options.connect, tls=tls))
