"""Six names are installed and no seventh: generic names at the top level are safe only as long as they are ours."""

from __future__ import annotations

import importlib
import inspect
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

OURS = ("protocol", "clock", "ponderpounce", "ponder_server", "pounce_server", "sim_client")
NEVER_INSTALLED = ("tests", "benchmarks", "docker", "docs", "examples")
ROOT = Path(__file__).parents[2]
SCRIPTS: dict[str, str] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


@pytest.mark.parametrize("name", OURS)
def test_each_room_comes_from_our_distribution_and_no_other(name: str) -> None:
    assert set(metadata.packages_distributions()[name]) == {"ponderpounce"}


def test_our_distribution_installs_the_six_rooms_and_nothing_else() -> None:
    names = {name for name, owners in metadata.packages_distributions().items() if "ponderpounce" in owners}
    assert {name for name in names if not name.startswith("__editable__")} == set(OURS)


def test_folders_that_are_no_packages_cannot_be_imported_from_elsewhere(tmp_path: Path) -> None:
    """A library that probes for the docker SDK must not find our Dockerfiles."""
    code = (
        "import importlib.util, sys\n"
        "for name in sys.argv[1:]:\n"
        "    spec = importlib.util.find_spec(name)\n"
        "    print(*(spec.submodule_search_locations or [spec.origin]) if spec else [])\n"
    )
    command = [sys.executable, "-c", code, *NEVER_INSTALLED]
    found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=30).stdout
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
