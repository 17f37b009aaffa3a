"""Who may import whom: the contracts of ``.importlinter``, and a home for each package that must not spread."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

ROOMS = ("protocol", "clock", "model_server", "dual_system", "ponder_server", "pounce_server", "sim_client")
HOMES: dict[str, tuple[str, ...]] = {
    "zenoh": ("protocol/zenoh_bus.py",),
    "mcap": ("protocol/mcap_log.py", "protocol/mcap_records.py"),
    "foxglove_schemas_protobuf": ("protocol/mcap_log.py",),
    "google": ("protocol/codec.py", "protocol/mcap_log.py"),
    "simplejpeg": ("protocol/images.py",),
    "prometheus_client": ("protocol/metrics.py", "protocol/status.py"),
    "rerun": ("sim_client/replay.py", "sim_client/blueprint.py"),
    "av": ("dual_system/data/video.py",),
    "pyarrow": ("dual_system/data/",),
    "ray": ("dual_system/data/workers.py",),
    "mujoco": ("dual_system/tasks/",),
    "torch": (
        "dual_system/models/",
        "dual_system/policy/",
        "dual_system/training/",
        "ponder_server/",
        "pounce_server/",
    ),
    "transformers": ("dual_system/models/",),
    "safetensors": ("dual_system/models/", "dual_system/training/"),
    "tokenizers": (
        "dual_system/models/ponder/vocabulary.py",
        "dual_system/models/groot/prompt.py",
        "dual_system/models/tokenizer_file.py",
    ),
    "sentencepiece": ("dual_system/models/pi05/prompt.py",),
}
"""Package -> the only files or folders that may import it. An import by name, in a string, counts as well."""
NOWHERE = ("robosuite", "cv2", "pickle", "random")
"""robosuite is located for its assets and never imported; the others have better answers here."""


def imported(source: str) -> set[str]:
    """Top-level names that a module imports, anywhere in it, ``importlib.import_module("name")`` included."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.partition(".")[0])
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if called in ("import_module", "__import__") and isinstance(node.args[0].value, str):
                found.add(node.args[0].value.partition(".")[0])
    return found


@pytest.fixture(scope="module")
def importers(root: Path, written: tuple[str, ...]) -> dict[str, set[str]]:
    """Package -> the files of our rooms that import it."""
    found: dict[str, set[str]] = defaultdict(set)
    for name in written:
        if name.partition("/")[0] in ROOMS:
            for package in imported((root / name).read_text(encoding="utf-8")):
                found[package].add(name)
    return found


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("import zenoh", {"zenoh"}),
        ("def f():\n    from mcap.writer import Writer", {"mcap"}),
        ("import importlib\nimportlib.import_module('rerun.blueprint')", {"importlib", "rerun"}),
        ("from . import zenoh", set()),
        ("'import zenoh'", set()),
    ],
)
def test_imports_are_found_wherever_they_hide(source: str, names: set[str]) -> None:
    assert imported(source) == names


@pytest.mark.parametrize("package", HOMES)
def test_a_package_with_a_home_is_imported_nowhere_else(package: str, importers: dict[str, set[str]]) -> None:
    strays = {name for name in importers[package] if not name.startswith(HOMES[package])}
    assert not strays, f"{package} lives in {', '.join(HOMES[package])}"


@pytest.mark.parametrize("package", [name for name in HOMES if name != "rerun"])
def test_a_home_is_lived_in(package: str, importers: dict[str, set[str]]) -> None:
    empty = [home for home in HOMES[package] if not any(name.startswith(home) for name in importers[package])]
    assert not empty, f"nothing in there imports {package} any more: shorten HOMES and .importlinter"


@pytest.mark.parametrize("package", NOWHERE)
def test_a_banned_package_is_imported_nowhere(package: str, importers: dict[str, set[str]]) -> None:
    assert not importers[package]


def test_every_import_contract_is_kept(root: Path) -> None:
    program = Path(sys.executable).with_name("lint-imports")  # a process: in ours it would disable the loggers
    found = subprocess.run([program, "--no-cache"], cwd=root, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr
