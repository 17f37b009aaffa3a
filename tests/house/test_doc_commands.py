"""Every command of the documents is parsed by the program that it names; nothing is run."""

from __future__ import annotations

import importlib
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from protocol import command_line

ROOT = Path(__file__).parents[2]
SCRIPTS: dict[str, str] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
BLOCKS = re.compile(r"^```\w*\n(.*?)^```|((?:^(?: {4}).*\n)+)", re.MULTILINE | re.DOTALL)
LINE = re.compile(rf"^\s*(?:sudo )?(?:\.venv/bin/)?({'|'.join(SCRIPTS)}) (.*)$")
A_LOG = re.compile(r"\$\([^()]*\)|\bFILE\b")


def commands(text: str) -> Iterator[tuple[str, str]]:
    """(program, arguments) of each command line that stands in a block; one with ``...`` in it is not whole."""
    variables = dict(re.findall(r'^\s+([A-Z]+)="(.*)"$', text, re.MULTILINE))
    for fenced, indented in BLOCKS.findall(text):
        for line in (fenced or indented).replace("\\\n", " ").splitlines():
            if (found := LINE.match(re.sub(r"(?<=\s)#.*$|\s+&$", "", line))) and " ... " not in f" {found[2]} ":
                filled = re.sub(r"\$([A-Z]+)", lambda name: variables.get(name[1], "0"), found[2])
                yield found[1], A_LOG.sub("a.mcap", " ".join(filled.split()))


LINES = sorted(
    {
        (path.relative_to(ROOT).as_posix(), *line)
        for folder in ("docs", ".", "examples", "integrations/ponderpounce_client", "integrations")
        for path in (ROOT / folder).glob("*.md")
        for line in commands(path.read_text(encoding="utf-8"))
    }
)


class Parsed(BaseException):
    """Raised in place of running what was parsed; no ``except`` of a command takes it."""


@pytest.fixture(autouse=True)
def only_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    parse = command_line.tyro.cli

    def and_stop(*arguments: Any, **options: Any) -> Any:
        parse(*arguments, **options)
        raise Parsed

    monkeypatch.setattr(command_line.tyro, "cli", and_stop)


def ends(program: str, arguments: str) -> None:
    module, _, attribute = SCRIPTS[program].partition(":")
    getattr(importlib.import_module(module), attribute)(shlex.split(arguments))


@pytest.mark.parametrize(("page", "program", "arguments"), LINES)
def test_a_command_of_the_documents_is_parsed(page: str, program: str, arguments: str) -> None:
    with pytest.raises(Parsed):
        ends(program, arguments)


def test_a_command_with_an_option_that_is_not_there_is_found() -> None:
    ((program, arguments),) = commands("Do:\n\n    .venv/bin/sim-client --tusk A \\\n      --out X   # this\n")
    assert (program, arguments) == ("sim-client", "--tusk A --out X")
    with pytest.raises(SystemExit):
        ends(program, arguments)


def test_most_pages_have_commands() -> None:
    assert len({page for page, _, _ in LINES}) > 15
