"""The three PEM files of mutual TLS, tried before anything depends on them."""

from __future__ import annotations

import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from protocol.access import COMMON_NAMES, ROLES
from protocol.errors import TransportError


@dataclass(frozen=True, slots=True, kw_only=True)
class Tls:
    """PEM files for mutual TLS, which authenticates both sides; the name in a certificate says what it is good for."""

    ca: Path
    certificate: Path
    key: Path


def check_files(tls: Tls) -> str:
    """Returns the common name of the certificate, after a handshake with itself in memory.

    Raises:
        TransportError: a file cannot be read, the key is another certificate's, the authority did not sign it, it has
            expired, or its name is none of the five roles.
    """
    try:
        server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        server.load_cert_chain(tls.certificate, tls.key)
        client = ssl.create_default_context(cafile=tls.ca)
        client.check_hostname = False  # zenoh checks the names of hosts; here only the signature counts
        name = _name_shown(server, client)
    except (OSError, ssl.SSLError) as error:  # an SSLError is an OSError, and says which check failed
        raise TransportError(
            f"--link.tls-certificate {tls.certificate}, --link.tls-key {tls.key} and --link.tls-ca {tls.ca} do not "
            f"work together: {error}"
        ) from None
    if not any(name in names for names in COMMON_NAMES.values()):
        raise TransportError(
            f"--link.tls-certificate {tls.certificate}: expected one for {', '.join(ROLES)}, came one for {name!r}. "
            "Others are obeyed nowhere; `pp-doctor certs FOLDER` makes a set"
        )
    return name


def _name_shown(server: ssl.SSLContext, client: ssl.SSLContext) -> str:
    """The common name that ``server``'s certificate shows to a ``client`` that accepts it."""
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [
        client.wrap_bio(to_client, to_server, server_side=False),
        server.wrap_bio(to_server, to_client, server_side=True),
    ]
    for _ in range(4):  # flights of a handshake
        for end in ends:
            try:
                end.do_handshake()
            except ssl.SSLWantReadError:
                continue
    shown: dict[str, Any] = ends[0].getpeercert() or {}
    names = [str(value) for part in shown.get("subject", ()) for key, value in part if key == "commonName"]
    return next(iter(names), "")
