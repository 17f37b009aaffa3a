"""Who can reach us: this host by default, others only over mutual TLS."""

from __future__ import annotations

from pathlib import Path

import pytest

from protocol.errors import TransportError
from protocol.options import LinkOptions
from protocol.zenoh_bus import LEASE_MS, Endpoints, Tls, is_loopback, zenoh_config

TLS = Tls(ca=Path("ca.pem"), certificate=Path("cert.pem"), key=Path("key.pem"))


@pytest.mark.parametrize(
    ("endpoint", "expected"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/127.1.2.3:7447", True),
        ("tcp/localhost:7447", True),
        ("tcp/[::1]:7447", True),
        ("udp/127.0.0.1:7447", True),
        ("tls/127.0.0.1:7447", True),
        ("unixsock-stream//tmp/pp.sock", True),
        ("tcp/127.0.0.1:7447?rel=1", True),
        ("tcp/127.0.0.1:7447#so_sndbuf=65000", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:7447", False),
        ("tcp/192.168.1.4:7447", False),
        ("tcp/[fe80::1]:7447", False),
        ("tcp/8.8.8.8:7447", False),
        ("tcp/robot.lan:7447", False),
        ("tcp/localhost.evil.org:7447", False),
        ("tcp/127.0.0.1.evil.org:7447", False),
        ("tcp/[::ffff:8.8.8.8]:7447", False),
        ("quic/10.0.0.2:7447", False),
        ("tcp/:7447", False),
        ("tcp/eth0", False),
    ],
)
def test_an_endpoint_is_loopback_only_if_nobody_else_can_reach_it(endpoint: str, expected: bool) -> None:
    assert is_loopback(endpoint) is expected


@pytest.mark.parametrize("endpoint", ["127.0.0.1:7447", "tcp/", "", "localhost"])
def test_an_endpoint_that_is_none_is_refused(endpoint: str) -> None:
    with pytest.raises(TransportError, match=r"expected PROTOCOL/ADDRESS, for example tcp/127\.0\.0\.1:7447"):
        is_loopback(endpoint)


@pytest.mark.parametrize("side", ["listen", "connect"])
@pytest.mark.parametrize(
    ("endpoint", "tls"),
    [
        ("tcp/0.0.0.0:7447", None),
        ("tcp/0.0.0.0:7447", TLS),
        ("udp/10.0.0.2:7447", TLS),
        ("tls/10.0.0.2:7447", None),
        ("quic/10.0.0.2:7447", None),
    ],
)
def test_an_open_door_without_tls_is_refused(side: str, endpoint: str, tls: Tls | None) -> None:
    with pytest.raises(TransportError, match=r"is not encrypted\. Use a loopback address, or tls/HOST:PORT"):
        Endpoints(**{side: (endpoint,)}, tls=tls)


@pytest.mark.parametrize("endpoint", ["tls/0.0.0.0:7447", "quic/robot.lan:7447"])
def test_an_open_door_with_tls_is_taken(endpoint: str) -> None:
    assert not Endpoints(listen=(endpoint,), tls=TLS).are_local


def test_one_remote_endpoint_makes_a_bus_remote() -> None:
    assert not Endpoints(listen=("tcp/127.0.0.1:1",), connect=("tls/robot.lan:2",), tls=TLS).are_local


def test_loopback_endpoints_are_local() -> None:
    assert Endpoints(listen=("tcp/127.0.0.1:1",), connect=("tcp/[::1]:2",)).are_local


def setting(endpoints: Endpoints, path: str) -> str:
    return zenoh_config(endpoints).get_json(path)


@pytest.mark.parametrize("path", ["scouting/multicast/enabled", "scouting/gossip/enabled"])
def test_strangers_are_not_scouted_for(path: str) -> None:
    assert setting(Endpoints(), path) == "false"


def test_the_lease_notices_a_frozen_peer_in_half_a_second() -> None:
    assert setting(Endpoints(), "transport/link/tx/lease") == str(LEASE_MS) == "500"


@pytest.mark.parametrize(
    ("endpoints", "expected"),
    [
        (Endpoints(connect=("tcp/127.0.0.1:1",)), "false"),
        (Endpoints(connect=("tcp/127.0.0.1:1",), shared_memory=True), "true"),
        (Endpoints(connect=("tls/robot.lan:1",), tls=TLS, shared_memory=True), "false"),
    ],
)
def test_shared_memory_is_asked_for_and_for_one_host(endpoints: Endpoints, expected: str) -> None:
    assert setting(endpoints, "transport/shared_memory/enabled") == expected


def test_tls_is_mutual() -> None:
    assert setting(Endpoints(listen=("tls/0.0.0.0:1",), tls=TLS), "transport/link/tls/enable_mtls") == "true"


def test_loopback_needs_no_files() -> None:
    assert LinkOptions().tls_files() is None


def test_three_tls_files_are_taken(tmp_path: Path) -> None:
    files = tuple(tmp_path / name for name in ("ca", "certificate", "key"))
    for file in files:
        file.touch()
    assert LinkOptions(tls_ca=files[0], tls_certificate=files[1], tls_key=files[2]).tls_files() == files


@pytest.mark.parametrize("missing", ["ca", "certificate", "key"])
def test_two_of_three_tls_files_are_refused(tmp_path: Path, missing: str) -> None:
    files = {name: tmp_path / name for name in ("ca", "certificate", "key") if name != missing}
    for file in files.values():
        file.touch()
    options = LinkOptions(**{f"tls_{name}": file for name, file in files.items()})
    with pytest.raises(TransportError, match=rf"--link\.tls-{missing} \(missing\) is not a file; mutual TLS needs all"):
        options.tls_files()


def test_a_tls_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    options = LinkOptions(tls_ca=tmp_path / "nowhere", tls_certificate=tmp_path, tls_key=tmp_path)
    with pytest.raises(TransportError, match=r"--link\.tls-ca .*nowhere is not a file"):
        options.tls_files()
