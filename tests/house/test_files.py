"""Facts about the files themselves: docstrings, long classes, pins, generated code, nothing of anybody's machine."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

MAX_CLASS_LINES = 250
WITHOUT_REASON: set[str] = {"Machine", "Motions"}
"""Longer classes whose docstrings do not yet say why they are one idea; no new ones."""

_MACHINE_PATH = re.compile(r"(?<![\w.~$})-])/(?:work|root|home|Users|mnt|scratch)/[\w.-]+")
_SECRET = re.compile(
    r"-----BEGIN [A-Z ]*PRIVATE KEY|\bgh[pousr]_[A-Za-z0-9]{30}|\bhf_[A-Za-z0-9]{30}|\bAKIA[0-9A-Z]{16}|://[^/\s:@]+:[^/\s:@]+@"
)

MAX_TREE_MIB = 48
"""Limit of the tracked files: a borrowed GPU takes a tree of 64 MiB, with what a run carries besides."""


@pytest.fixture(scope="module")
def texts(root: Path, files: tuple[str, ...]) -> dict[str, str]:
    """Every text file of ours."""
    found = {}
    for name in files:
        data = (root / name).read_bytes()
        if b"\0" not in data[:8192]:
            found[name] = data.decode("utf-8")
    return found


def test_the_tree_can_travel_to_a_gpu(root: Path, files: tuple[str, ...]) -> None:
    sizes = {name: (root / name).stat().st_size for name in files}
    largest = sorted(sizes, key=sizes.__getitem__)[-5:]
    assert sum(sizes.values()) <= MAX_TREE_MIB << 20, f"largest: {[(name, sizes[name]) for name in largest]}"


def test_every_module_says_in_a_docstring_what_it_is(root: Path, written: tuple[str, ...]) -> None:
    silent = []
    for name in written:
        source = (root / name).read_text(encoding="utf-8")
        if not source.strip() or re.match(r'"""[^\s"]', source):
            continue  # to parse all takes seconds
        if not ast.get_docstring(ast.parse(source)):
            silent.append(name)
    assert not silent


def test_a_long_class_says_why_it_is_one_idea(root: Path, written: tuple[str, ...]) -> None:
    silent = set()
    for name in written:
        source = (root / name).read_text(encoding="utf-8")
        first = re.search(r"^\s*class\s", source, re.MULTILINE)
        if first is None or source.count("\n", first.start()) < MAX_CLASS_LINES:
            continue  # to parse all takes seconds
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ClassDef) and (node.end_lineno or 0) - node.lineno >= MAX_CLASS_LINES:
                silent |= set() if "because" in (ast.get_docstring(node) or "") else {node.name}
    assert silent == WITHOUT_REASON, f"beyond {MAX_CLASS_LINES} lines a docstring says because of what"


@pytest.mark.parametrize(
    ("text", "is_found"),
    [
        ("see /ho" + "me/anna/models", True),
        ("cd /ro" + "ot/x", True),
        ("../shared/work/x", False),
        ("pp/@v1/home/x", False),
    ],
)
def test_a_machine_path_is_recognised(text: str, is_found: bool) -> None:
    assert bool(_MACHINE_PATH.search(text)) is is_found


def test_no_file_names_a_place_on_somebodys_machine(texts: dict[str, str]) -> None:
    found = {name: match.group() for name, text in texts.items() if (match := _MACHINE_PATH.search(text))}
    assert not found


def test_no_file_holds_a_secret(texts: dict[str, str]) -> None:
    assert not [name for name, text in texts.items() if _SECRET.search(text)]


def test_generated_modules_are_what_the_generator_makes_of_the_schemas(root: Path, tmp_path: Path) -> None:
    """The Makefile's ``proto`` target, into an empty folder."""
    schemas = sorted(str(path.relative_to(root)) for path in (root / "protocol").rglob("*.proto"))
    arguments = ["-I", ".", f"--python_out={tmp_path}", f"--pyi_out={tmp_path}", *schemas]
    subprocess.run([sys.executable, "-m", "grpc_tools.protoc", *arguments], cwd=root, check=True, timeout=60)
    made = {str(path.relative_to(tmp_path)): path.read_bytes() for path in tmp_path.rglob("*_pb2.py*")}
    committed = {
        str(path.relative_to(root)): path.read_bytes()
        for pattern in ("*_pb2.py", "*_pb2.pyi")
        for path in (root / "protocol").rglob(pattern)
    }
    assert made.keys() == committed.keys()
    assert [name for name in made if made[name] != committed[name]] == [], "run `make proto` and commit"


# -- versions: pyproject says what may be, requirements.txt what is


def _bounds(root: Path) -> list[Requirement]:
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"].values()
    bounds = [Requirement(line) for lines in (project["dependencies"], *extras) for line in lines]
    return [bound for bound in bounds if bound.name != project["name"]]  # an extra that is made of others


def _pins(root: Path) -> dict[str, str]:
    """Name -> version of what CI installs: requirements.txt, and what the Makefile installs by itself."""
    lines = (root / "requirements.txt").read_text().splitlines()
    pinned = [line.partition("#")[0].strip() for line in lines]
    pinned += re.findall(r"\b[\w-]+==[\w.]+", (root / "Makefile").read_text())
    pins = {}
    for line in filter(None, pinned):
        requirement = Requirement(line)
        (specifier,) = requirement.specifier
        assert specifier.operator == "==", f"{line}: a pin is =="
        pins[_canonical(requirement.name)] = specifier.version
    return pins


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_dependency_is_pinned(root: Path) -> None:
    assert {_canonical(bound.name) for bound in _bounds(root)} - _pins(root).keys() == set()


def test_every_pin_lies_within_its_bounds(root: Path) -> None:
    pins = _pins(root)
    outside = [
        f"{bound} but pinned {pins[name]}"
        for bound in _bounds(root)
        if (name := _canonical(bound.name)) in pins and not bound.specifier.contains(pins[name])
    ]
    assert not outside


def test_what_is_installed_beside_pip_s_resolver_is_no_dependency(root: Path) -> None:
    """robosuite's own pins contradict numpy 2: as a dependency it would make the whole set unsolvable."""
    assert not {_canonical(bound.name) for bound in _bounds(root)} & {"robosuite", "openpi-client", "opencv-python"}
