"""The servers of ``--local`` get what their user asked of links, and lie where nobody else can reach them."""

from __future__ import annotations

import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from protocol.options import LinkOptions
from protocol.sockets import socket_path
from sim_client.config import ModelsOptions
from sim_client.launch import Daemons, local_link


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[str]]:
    """The arguments of every daemon, in the place of processes."""
    found: dict[str, list[str]] = {}

    def pretend(self: Daemons, name: str, module: str, arguments: Sequence[str]) -> Any:
        found[name] = list(arguments)

    monkeypatch.setattr(Daemons, "start", pretend)
    return found


def test_local_servers_obey_the_options_of_the_link(started: dict[str, list[str]], tmp_path: Path) -> None:
    asked = LinkOptions(robot="r7")
    with Daemons(tmp_path) as daemons:
        link = local_link(
            daemons,
            asked,
            with_clock=True,
            allow_starved=False,
            with_ponder=True,
            ponder_checkpoint=None,
            pounce_checkpoint=None,
        )
        assert (link.robot, len(link.connect)) == ("r7", 3)
        (folder,) = {path.parent for path in map(socket_path, link.connect) if path}
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert not folder.exists()
    assert all(arguments[:2] == ["--link.robot", "r7"] for arguments in started.values())


def test_pounce_alone_needs_no_ponder(started: dict[str, list[str]], tmp_path: Path) -> None:
    with Daemons(tmp_path) as daemons:
        link = local_link(
            daemons,
            LinkOptions(),
            with_clock=True,
            allow_starved=False,
            with_ponder=False,
            ponder_checkpoint=None,
            pounce_checkpoint=None,
        )
    assert (set(started), len(link.connect)) == ({"pounce", "clock"}, 2)
    alone = started["clock"].index("--ponder")
    assert started["clock"][alone + 1] == "none"


def test_local_servers_get_device_precision_and_path(started: dict[str, list[str]], tmp_path: Path) -> None:
    with Daemons(tmp_path) as daemons:
        local_link(
            daemons, LinkOptions(), with_clock=False, allow_starved=False, with_ponder=True,
            ponder_checkpoint=Path("p"), pounce_checkpoint=None,
            models=ModelsOptions(device="cuda", dtype="bfloat16", path="compile"),
        )  # fmt: skip
    both = ["--device", "cuda", "--dtype", "bfloat16"]
    assert started["ponder"][-6:] == ["--checkpoint", "p", *both]
    assert started["pounce"][-6:] == [*both, "--path", "compile"]
