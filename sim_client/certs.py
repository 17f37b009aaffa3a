"""``pp-doctor certs``: an authority and a certificate for each role, for processes on several hosts.

The name in a certificate is what it is good for (`protocol.access`). ``openssl`` makes the files.
"""

from __future__ import annotations

import ipaddress
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from protocol.access import ROLES
from protocol.command_line import parse
from protocol.errors import TransportError
from protocol.tls import Tls, check_files

_NEW_KEY = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")


@dataclass(frozen=True, slots=True, kw_only=True)
class CertsOptions:
    """Makes an authority and a certificate each for clock, ponder, pounce, robot and viewer, for mutual TLS."""

    folder: tyro.conf.Positional[Path]
    """New folder for ca.pem, ca.key, and ROLE.pem and ROLE.key of every role."""
    hosts: tuple[str, ...] = ("127.0.0.1", "localhost")
    """Names and addresses under which the processes are connected to."""
    days: int = 825
    """Days until the certificates expire."""


def make_certificates(options: CertsOptions) -> list[Tls]:
    """Returns the files of every role, in the order of ``ROLES``.

    Raises:
        TransportError: there is no openssl, the folder exists or cannot be written, or a host's name is refused.
    """
    if shutil.which("openssl") is None:
        raise TransportError("openssl is not installed, and makes the files: apt-get install openssl")
    folder = options.folder
    try:
        folder.mkdir(mode=0o700, parents=True)
    except OSError as error:
        raise TransportError(f"{folder}: expected a folder that can be made, {error.strerror}") from None
    days = ("-days", str(options.days))
    authority = ("-subj", "/CN=PonderPounce authority", "-keyout", "ca.key", "-out", "ca.pem")
    _openssl(folder, "req", "-x509", *_NEW_KEY, *authority, *days)
    names = ",".join(f"{'IP' if _is_address(host) else 'DNS'}:{host}" for host in options.hosts)
    (folder / "names").write_text(f"subjectAltName={names}\n")
    for role in ROLES:
        _openssl(folder, "req", *_NEW_KEY, "-subj", f"/CN={role}", "-keyout", f"{role}.key", "-out", "request")
        signed = ("-in", "request", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-extfile", "names")
        _openssl(folder, "x509", "-req", *signed, "-out", f"{role}.pem", *days)
    for file in ("names", "request", "ca.srl"):
        (folder / file).unlink(missing_ok=True)
    made = [Tls(ca=folder / "ca.pem", certificate=folder / f"{role}.pem", key=folder / f"{role}.key") for role in ROLES]
    for files in made:
        check_files(files)
    return made


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _openssl(folder: Path, *arguments: str) -> None:
    ran = subprocess.run(["openssl", *arguments], cwd=folder, capture_output=True, text=True, check=False)
    if ran.returncode != 0:
        raise TransportError(f"openssl {arguments[0]}: {ran.stderr.strip().splitlines()[-1]}")


def main(argv: list[str]) -> int:
    options = parse(CertsOptions, argv, prog="pp-doctor certs")
    try:
        made = make_certificates(options)
    except TransportError as error:
        sys.stderr.write(f"pp-doctor certs: {error}\n")
        return 2
    sys.stdout.write(
        f"{options.folder}: an authority and {len(made)} certificates, for {', '.join(options.hosts)}, good for "
        f"{options.days} days. Give every host ca.pem and its own role's two files only; keep ca.key off all of them.\n"
    )
    return 0
