"""Seven names are installed and no eighth: generic names at the top level are safe only as long as they are ours."""

from __future__ import annotations

import importlib
import inspect
import os
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

DISTRIBUTION = "ponderpounce-server"
OURS = ("protocol", "clock", "model_server", "dual_system", "ponder_server", "pounce_server", "sim_client")
NEVER_INSTALLED = ("tests", "benchmarks", "docker", "docs", "examples")
ROOT = Path(__file__).parents[2]
SCRIPTS: dict[str, str] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


@pytest.mark.parametrize("name", OURS)
def test_each_room_comes_from_our_distribution_and_no_other(name: str) -> None:
    assert set(metadata.packages_distributions()[name]) == {DISTRIBUTION}


def test_our_distribution_installs_the_rooms_and_nothing_else() -> None:
    names = {name for name, owners in metadata.packages_distributions().items() if DISTRIBUTION in owners}
    assert {name for name in names if not name.startswith("__editable__")} == set(OURS)


STUB = {
    "ponderpounce/__init__.py": 'WHOSE = "the authors of the paper"\n',
    "ponderpounce-9.9.dist-info/METADATA": "Metadata-Version: 2.1\nName: ponderpounce\nVersion: 9.9\n",
    "ponderpounce-9.9.dist-info/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    "ponderpounce-9.9.dist-info/RECORD": "",
}
BESIDE_OURS = """
import importlib, sys
from importlib import metadata
import ponderpounce
from protocol.version import version
assert ponderpounce.WHOSE == "the authors of the paper"
for room in sys.argv[1:]:
    importlib.import_module(room)
from protocol.ponderpounce.v1 import common_pb2
assert metadata.version("ponderpounce") == "9.9"
assert version().startswith(metadata.version("ponderpounce-server")), version()
"""


def test_the_authors_package_may_be_installed_beside_ours(tmp_path: Path) -> None:
    """`ponderpounce` is the name of the paper's authors' package: ours takes neither it nor its distribution's."""
    wheel, beside = tmp_path / "ponderpounce-9.9-py3-none-any.whl", tmp_path / "beside"
    with zipfile.ZipFile(wheel, "w") as file:
        for name, text in STUB.items():
            file.writestr(name, text)
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-cache-dir"]
    subprocess.run([*install, "--target", str(beside), str(wheel)], check=True, capture_output=True, timeout=60)
    path = os.pathsep.join([str(beside), str(ROOT)])
    command = [sys.executable, "-c", BESIDE_OURS, *OURS]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr


def test_folders_that_are_no_packages_cannot_be_imported_from_elsewhere(tmp_path: Path) -> None:
    """A library that probes for the docker SDK must not find our Dockerfiles."""
    code = (
        "import importlib.util, sys\n"
        "for name in sys.argv[1:]:\n"
        "    spec = importlib.util.find_spec(name)\n"
        "    print(*(spec.submodule_search_locations or [spec.origin]) if spec else [])\n"
    )
    command = [sys.executable, "-c", code, *NEVER_INSTALLED]
    installed = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    found = subprocess.run(
        command, cwd=tmp_path, env=installed, capture_output=True, text=True, check=True, timeout=30
    ).stdout
    assert not [place for place in found.split() if Path(place).is_relative_to(ROOT)]


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_console_script_names_a_main_that_takes_arguments_and_returns_a_code(script: str) -> None:
    module, _, attribute = SCRIPTS[script].partition(":")
    main = getattr(importlib.import_module(module), attribute)
    signature = inspect.signature(main)
    assert signature.parameters["argv"].default is None
    assert signature.return_annotation in (int, "int")


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_console_script_explains_itself(script: str, capsys: pytest.CaptureFixture[str]) -> None:
    module, _, attribute = SCRIPTS[script].partition(":")
    main = getattr(importlib.import_module(module), attribute)
    with pytest.raises(SystemExit) as left:
        main(["--help"])
    assert left.value.code == 0
    assert f"usage: {script}" in capsys.readouterr().out
