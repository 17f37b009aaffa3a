"""Every ``--help`` says of each option what it does, and of ``--no-x`` what is not done."""

from __future__ import annotations

import argparse
import importlib
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tyro

from dual_system.commands import COMMANDS
from protocol import command_line

ROOT = Path(__file__).parents[2]
SCRIPTS: dict[str, str] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
VERBS = {f"{name} {verb}": [verb] for name, command in COMMANDS.items() for verb in command.verbs}
MOST_COMMANDS = 16
_GENERATED = re.compile(r"\((default: .*|required|repeatable)\)$", re.DOTALL)


class Parsed(Exception):
    """A command came as far as its command line."""


def parser_of(name: str, monkeypatch: pytest.MonkeyPatch) -> argparse.ArgumentParser:
    parsers: list[argparse.ArgumentParser] = []

    def cli(kind: Any, *, args: Any, **options: Any) -> None:
        parsers.append(tyro.extras.get_parser(kind, **options))
        raise Parsed

    monkeypatch.setattr(command_line.tyro, "cli", cli)
    module, _, function = SCRIPTS[name.split()[0]].partition(":")
    main: Callable[[list[str]], int] = getattr(importlib.import_module(module), function)
    with pytest.raises(Parsed):
        main(VERBS.get(name, []))
    return parsers[0]


@pytest.mark.filterwarnings("ignore:get_parser")  # what it has no other door to: help texts as data
@pytest.mark.parametrize("name", [*SCRIPTS, *VERBS])
def test_each_option_says_what_it_does(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    parser = parser_of(name, monkeypatch)
    assert parser.description, f"{name} does not say what it does"
    faults = []
    for action in parser._actions:
        flags, sentence = action.option_strings or [action.dest], _GENERATED.sub("", action.help or "").strip()
        is_negation = any(flag.rpartition(".")[2].removeprefix("--").startswith("no-") for flag in flags)
        if not sentence.endswith((".", "exit")) or is_negation != sentence.startswith("Do not "):
            faults.append(f"{name} {' '.join(flags)}: {action.help!r}")
    assert not faults


def test_no_command_is_one_too_many() -> None:
    assert len(SCRIPTS) <= MOST_COMMANDS
