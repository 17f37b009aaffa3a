"""Options of every daemon: the robot, the endpoints to listen on and to connect to, and what operators read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from protocol.errors import TransportError


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkOptions:
    """Connections to the other processes. Between hosts all three TLS files are needed."""

    robot: str = "r0"
    """Name of the robot; part of every key."""
    listen: tuple[str, ...] = ()
    """Zenoh endpoints to listen on, e.g. unixsock-stream/PATH, tcp/127.0.0.1:7448 or tls/0.0.0.0:7448."""
    connect: tuple[str, ...] = ()
    """Zenoh endpoints of the other processes; connecting is retried until they are there."""
    tls_ca: Path | None = None
    """Certificate of the authority that signed all processes' certificates, in PEM."""
    tls_certificate: Path | None = None
    """This process's certificate, in PEM."""
    tls_key: Path | None = None
    """Private key of that certificate, in PEM."""

    def tls_files(self) -> tuple[Path, Path, Path] | None:
        """Returns (ca, certificate, key), or None.

        Raises:
            TransportError: only some of the three are given, or one is not a file.
        """
        files = (self.tls_ca, self.tls_certificate, self.tls_key)
        if not any(files):
            return None
        for name, file in zip(("ca", "certificate", "key"), files, strict=True):
            if file is None or not file.is_file():
                raise TransportError(
                    f"--link.tls-{name} {file or '(missing)'} is not a file; mutual TLS needs all three"
                )
        return files  # type: ignore[return-value]


@dataclass(frozen=True, slots=True, kw_only=True)
class OperationsOptions:
    """What a process tells its operators."""

    metrics: str | None = None
    """HOST:PORT for /metrics (Prometheus), /healthz and /readyz, e.g. 127.0.0.1:9448. None: no port is opened."""
    metrics_open_to_anyone: bool = False
    """Let --metrics listen beyond loopback: any host that reaches the port reads the numbers, without a password."""
    log_json: bool = False
    """Write each log line as a JSON object."""
    log_file: Path | None = None
    """File for log lines, instead of standard error. A full file moves to NAME.1 and on to NAME.4, the oldest goes."""
    log_mb: int = 100
    """Limit of all files of --log-file together, in MB; at least 5."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DaemonOptions(OperationsOptions):
    """What a daemon tells its operators, and how it leaves."""

    drain: bool = False
    """At SIGTERM, open no more episodes and leave when the running one is over, as at SIGUSR1. A second SIGTERM, or
    SIGINT, ends the process as usual."""
