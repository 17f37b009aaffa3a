"""What a person sees who types something wrong: one sentence that names the way out, exit code 2, and no traceback."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Mapping
from typing import Any, NamedTuple

import pytest

pytestmark = pytest.mark.e2e

SERVERS = ("clock", "ponder_server", "pounce_server")
SCRIPT = """
import contextlib, io, json, runpy, sys
module, told = sys.argv[1], []
for arguments in json.loads(sys.argv[2]):
    sys.argv = [module, *arguments]
    output, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        try:
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        except SystemExit as left:
            told.append((left.code, output.getvalue(), errors.getvalue()))
print(json.dumps(told))
"""
"""A program several times in one process, so that it is imported once. Whatever it raises but an exit ends this one."""


class Told(NamedTuple):
    code: int
    output: str
    errors: str

    def refused(self) -> str:
        """What it said, having refused in good order."""
        assert self.code == 2, self.errors
        assert "Traceback" not in self.errors
        return self.errors


def _told(module: str, commands: Mapping[str, list[str]]) -> dict[str, Told]:
    """What a program told to each of these commands, by the name that the command has here."""
    arguments = [sys.executable, "-c", SCRIPT, module, json.dumps([*commands.values()])]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return {name: Told(*each) for name, each in zip(commands, json.loads(done.stdout), strict=True)}


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Told]:
    out = ["--out", str(tmp_path_factory.mktemp("out"))]
    commands = {
        "mistyped task": ["--task", "PickHighlights", *out],
        "list": ["--list-tasks"],
        "mistyped option": ["--spped", "3"],
        "one thread": ["--in-process", "--mode", "realtime", *out],
    }
    return _told("sim_client", commands)


@pytest.fixture(scope="module", params=SERVERS)
def server(request: pytest.FixtureRequest) -> tuple[str, dict[str, Told]]:
    """A server's port, which another program has, and what the server told."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        commands = {
            "mistyped option": ["--spped", "3"],
            "open": ["--link.listen", "tcp/0.0.0.0:0"],
            "taken": ["--link.listen", endpoint],
        }
        return endpoint, _told(request.param, commands)


def test_a_mistyped_task_is_answered_with_the_one_that_was_meant(client: dict[str, Told]) -> None:
    said = client["mistyped task"].refused()
    assert "unknown task 'PickHighlights'" in said
    assert "Did you mean 'PickHighlight'?" in said


def test_list_tasks_prints_one_name_per_line(client: dict[str, Told]) -> None:
    told = client["list"]
    assert told.code == 0
    assert "PickHighlight" in told.output.splitlines()


def test_an_unknown_option_is_an_error(client: dict[str, Told], server: Any) -> None:
    _, told = server
    for each in (client, told):
        assert "--spped" in each["mistyped option"].refused()


def test_an_endpoint_open_to_the_network_is_refused_without_tls(server: Any) -> None:
    _, told = server
    said = told["open"].refused()
    assert "tcp/0.0.0.0:0" in said
    assert "tls/" in said


def test_a_taken_port_is_named(server: Any) -> None:
    endpoint, told = server
    assert endpoint in told["taken"].refused()


def test_one_thread_cannot_keep_real_time(client: dict[str, Told]) -> None:
    assert "--mode lockstep" in client["one thread"].refused()
