"""Commands whose modules are imported when they run: those with verbs, and those that need packages of an extra.

``pp-collect --out DIR`` runs the command's default module, ``pp-collect correct LOG...`` the module of a verb. Each
needs only its own dependencies (pp-collect runs without torch, pp-export hf without MuJoCo), and says which extra has
them where they are missing.
"""

from __future__ import annotations

import difflib
import importlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from protocol.command_line import REFUSED, command


@dataclass(frozen=True, slots=True)
class Verb:
    """A verb's module, whose ``main(argv, prog=...)`` is called, and one line for ``--help``."""

    module: str
    summary: str


@dataclass(frozen=True, slots=True)
class Command:
    """The module that runs without a verb, whose ``main(argv)`` is called, and the verbs."""

    default: str
    verbs: Mapping[str, Verb] = field(default_factory=dict)


COMMANDS = {
    "sim-client": Command("sim_client.__main__"),
    "pp-eval": Command("sim_client.evaluate"),
    "pp-train": Command("dual_system.training.train"),
    "pp-gateway": Command("sim_client.gateway.__main__"),
    "pp-collect": Command(
        "dual_system.data.collect",
        {
            "correct": Verb("dual_system.data.correct", "Relabel recorded episodes with the oracle (DAgger)."),
            "import": Verb("dual_system.data.import_sets", "Import LeRobot v3 folders or RoboMME's HDF5 files."),
            "bags": Verb("sim_client.bags", "Make a LeRobot v3 set of rosbag2 recordings in MCAP."),
            "card": Verb("dual_system.data.card", "Write a dataset's README.md and contact sheet."),
            "kitchen": Verb("dual_system.data.kitchen", "Collect pairs of two bodies of the kitchen's tasks."),
            "pairs": Verb("dual_system.tasks.pair_files", "Collect counterfactual pairs: two pasts of one present."),
        },
    ),
    "pp-export": Command(
        "dual_system.data.export",
        {
            "hf": Verb(
                "dual_system.models.ponder.export_hf", "Export trained models as the public folders they came from."
            )
        },
    ),
    "pp-parity": Command(
        "dual_system.models.parity",
        {
            "official": Verb(
                "dual_system.models.official.inspect_folder", "Say what an official PonderPounce folder holds."
            ),
            "import-official": Verb(
                "dual_system.models.official.import_folder", "Import the official PonderPounce folder."
            ),
            "answers": Verb(
                "sim_client.parity_answers", "Run a stored episode through a pair, and compare with another's answers."
            ),
        },
    ),
    "pp-replay": Command(
        "sim_client.replay",
        {
            "through": Verb(
                "sim_client.replay_through", "Answer a log's invocations with another POUNCE, and compare row by row."
            ),
            "watch": Verb("sim_client.watch.__main__", "Show a robot's live status as a page for a browser."),
        },
    ),
    "pp-diagnose": Command(
        "dual_system.training.diagnose",
        {
            "counterfactual": Verb(
                "sim_client.counterfactual", "Score how often a trained pair's action follows its own past."
            ),
            "probe": Verb("dual_system.training.probe", "Probe what C and a frame memory's read-out hold."),
            "words": Verb("dual_system.training.words", "Measure a PONDER's texts on episodes of other scenes."),
        },
    ),
}


@command("sim-client")
def sim_client(argv: list[str] | None = None) -> int:
    """``sim-client``."""
    return _run("sim-client", sys.argv[1:] if argv is None else argv)


@command("pp-eval")
def evaluate(argv: list[str] | None = None) -> int:
    """``pp-eval``."""
    return _run("pp-eval", sys.argv[1:] if argv is None else argv)


@command("pp-train")
def train(argv: list[str] | None = None) -> int:
    """``pp-train``."""
    return _run("pp-train", sys.argv[1:] if argv is None else argv)


@command("pp-gateway")
def gateway(argv: list[str] | None = None) -> int:
    """``pp-gateway``."""
    return _run("pp-gateway", sys.argv[1:] if argv is None else argv)


@command("pp-collect")
def collect(argv: list[str] | None = None) -> int:
    """``pp-collect``."""
    return _run("pp-collect", sys.argv[1:] if argv is None else argv)


@command("pp-export")
def export(argv: list[str] | None = None) -> int:
    """``pp-export``."""
    return _run("pp-export", sys.argv[1:] if argv is None else argv)


@command("pp-parity")
def parity(argv: list[str] | None = None) -> int:
    """``pp-parity``."""
    return _run("pp-parity", sys.argv[1:] if argv is None else argv)


@command("pp-diagnose")
def diagnose(argv: list[str] | None = None) -> int:
    """``pp-diagnose``."""
    return _run("pp-diagnose", sys.argv[1:] if argv is None else argv)


@command("pp-replay")
def replay(argv: list[str] | None = None) -> int:
    """``pp-replay``."""
    return _run("pp-replay", sys.argv[1:] if argv is None else argv)


def _run(name: str, argv: list[str]) -> int:
    command, first = COMMANDS[name], argv[0] if argv else ""
    if first in command.verbs:
        return _main(command.verbs[first].module, argv[1:], prog=f"{name} {first}")
    if command.verbs and _is_mistyped(first):
        close = difflib.get_close_matches(first, command.verbs, n=1)
        hint = f"Did you mean {close[0]!r}? " if close else ""
        sys.stderr.write(f"{name}: {first!r} is neither a verb nor a file. {hint}Verbs: {', '.join(command.verbs)}.\n")
        return REFUSED
    try:
        return _main(command.default, argv)
    finally:
        if command.verbs and {"-h", "--help"} & set(argv):
            sys.stdout.write(_listed(name, command.verbs))


def _is_mistyped(first: str) -> bool:
    """Whether a first argument can only be meant as a verb: it is a plain word and no file."""
    return first.isalpha() and not Path(first).exists()


def _listed(name: str, verbs: Mapping[str, Verb]) -> str:
    width = max(map(len, verbs))
    lines = [f"  {name} {verb:{width}}  {of.summary}" for verb, of in verbs.items()]
    return "\n".join(["verbs, each with its own --help:", *lines, ""])


def _main(module: str, argv: Sequence[str], **options: Any) -> int:
    code: int = importlib.import_module(module).main(list(argv), **options)
    return code
