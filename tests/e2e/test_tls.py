"""Mutual TLS between two processes' buses: who has no certificate of ours hears nothing and is not heard."""

from __future__ import annotations

import shutil
import socket
import subprocess
import time
from contextlib import closing
from pathlib import Path

import pytest

from protocol.bus import Subscription
from protocol.errors import TransportError
from protocol.topics import Priority
from protocol.zenoh_bus import Endpoints, Tls, ZenohBus

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the throw-away certificates"),
]

KEY = "pp/@v1/r0/ep/e/obs"


def _openssl(*arguments: str, cwd: Path) -> None:
    subprocess.run(["openssl", *arguments], cwd=cwd, check=True, capture_output=True)


def _authority(folder: Path) -> Path:
    """A throw-away certificate authority in ``folder``."""
    folder.mkdir()
    subject = ["-subj", "/CN=throw-away", "-days", "1"]
    _openssl(
        "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", "ca.key", "-out", "ca.pem", *subject, cwd=folder
    )
    return folder


def _member(authority: Path, name: str) -> Tls:
    """Certificate and key of one process, signed by ``authority``."""
    (authority / "ext").write_text("subjectAltName=IP:127.0.0.1,DNS:localhost\n")
    request = ["-newkey", "rsa:2048", "-nodes", "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}"]
    _openssl("req", *request, cwd=authority)
    signed = ["-in", f"{name}.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-out", f"{name}.pem"]
    _openssl("x509", "-req", *signed, "-days", "1", "-extfile", "ext", cwd=authority)
    return Tls(ca=authority / "ca.pem", certificate=authority / f"{name}.pem", key=authority / f"{name}.key")


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _authority(tmp_path_factory.mktemp("tls") / "ours")


@pytest.fixture(scope="module")
def strangers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _authority(tmp_path_factory.mktemp("tls") / "strangers")


@pytest.fixture
def endpoint() -> str:
    with closing(socket.socket()) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    return f"tls/127.0.0.1:{port}"


def _heard(talker: ZenohBus, subscription: Subscription, within_s: float) -> bool:
    """Whether one of many messages arrives."""
    deadline_s = time.monotonic() + within_s
    while time.monotonic() < deadline_s:
        talker.publish(KEY, b"hello", encoding="x", attachment=b"", priority=Priority.DATA)
        talker.wait(20_000_000)
        if subscription.drain():
            return True
    return False


def test_members_hear_each_other(ours: Path, endpoint: str) -> None:
    with (
        closing(ZenohBus(Endpoints(listen=(endpoint,), tls=_member(ours, "pounce")))) as server,
        closing(ZenohBus(Endpoints(connect=(endpoint,), tls=_member(ours, "sim")))) as client,
    ):
        assert _heard(client, server.subscribe(KEY, keep=1), within_s=10)


def test_a_stranger_is_not_heard(ours: Path, strangers: Path, endpoint: str) -> None:
    with (
        closing(ZenohBus(Endpoints(listen=(endpoint,), tls=_member(ours, "pounce")))) as server,
        closing(ZenohBus(Endpoints(connect=(endpoint,), tls=_member(strangers, "sim")))) as client,
        closing(ZenohBus(Endpoints(connect=(endpoint,), tls=_member(ours, "witness")))) as witness,
    ):
        subscription = server.subscribe(KEY, keep=1)
        assert _heard(witness, subscription, within_s=10)  # the door is open for members
        subscription.drain()
        assert not _heard(client, subscription, within_s=2)


def test_a_reachable_endpoint_without_tls_is_refused() -> None:
    with pytest.raises(TransportError, match="not encrypted"):
        Endpoints(listen=("tcp/0.0.0.0:7448",))
