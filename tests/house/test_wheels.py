"""What is installed from the wheels: every module, data file and command, and nothing else."""

from __future__ import annotations

import configparser
import importlib.util
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from protocol import extras
from protocol.command_line import REFUSED, command

BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
INTEGRATIONS = Path(__file__).parents[2] / "integrations"
NOT_INSTALLED = ("tests", "benchmarks", "examples", "docs", "docker", "checkpoints", "integrations", "site")
DISTRIBUTION_OF = {"PIL": "pillow", "rerun": "rerun-sdk", "zmq": "pyzmq", "tokenizers": "transformers"}


def built(root: Path, files: tuple[str, ...], folder: str, scratch: Path) -> zipfile.ZipFile:
    """The wheel that pip would build of a folder of the repository, without a network."""
    for name in files:
        if Path(name).is_relative_to(folder) and Path(name).parts[0] not in ("checkpoints", ".ci"):
            (scratch / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(root / name, scratch / name)
    out = scratch / "dist"
    out.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", BUILD, str(out)], cwd=scratch / folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    (wheel,) = out.glob("*.whl")
    return zipfile.ZipFile(wheel)


@pytest.fixture(scope="module")
def server(root: Path, files: tuple[str, ...], tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    return built(root, files, ".", tmp_path_factory.mktemp("server"))


def _rooms(names: tuple[str, ...]) -> set[str]:
    return {name for name in names if "/" in name and Path(name).parts[0] not in NOT_INSTALLED and name[0] != "."}


def test_the_wheel_has_every_module_and_data_file_and_nothing_else(
    server: zipfile.ZipFile, files: tuple[str, ...]
) -> None:
    installed = {name for name in server.namelist() if ".dist-info/" not in name}
    schemas = {name for name in files if name.endswith(".proto")}  # of which the generated modules are made
    assert installed == _rooms(files) - schemas


def test_every_command_of_the_wheel_leads_to_a_module_in_it(server: zipfile.ZipFile, root: Path) -> None:
    (file,) = (name for name in server.namelist() if name.endswith("entry_points.txt"))
    entries = configparser.ConfigParser()
    entries.read_string(server.read(file).decode())
    scripts = tomllib.loads((root / "pyproject.toml").read_text())["project"]["scripts"]
    assert dict(entries["console_scripts"]) == scripts
    modules = {target.partition(":")[0].replace(".", "/") + ".py" for target in scripts.values()}
    assert modules <= set(server.namelist())


@pytest.mark.parametrize("folder", sorted(path.parent.name for path in INTEGRATIONS.glob("*/pyproject.toml")))
def test_an_integration_s_wheel_is_its_one_package(
    folder: str, root: Path, files: tuple[str, ...], tmp_path: Path
) -> None:
    place = f"{INTEGRATIONS.name}/{folder}"
    wheel = built(root, files, place, tmp_path)
    installed = {f"{place}/{name}" for name in wheel.namelist() if ".dist-info/" not in name}
    assert installed == {name for name in files if name.startswith(f"{place}/{folder}/")}


@pytest.mark.parametrize(("package", "extra"), extras.EXTRA_OF.items())
def test_the_extra_that_is_named_brings_the_package(package: str, extra: str, root: Path) -> None:
    optional = tomllib.loads((root / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    brought = {Requirement(line).name for line in optional[extra]}
    assert DISTRIBUTION_OF.get(package, package).replace("_", "-") in brought


def test_a_command_without_its_extra_names_the_line_that_installs_it(capsys: pytest.CaptureFixture[str]) -> None:
    @command("pp-x")
    def main(argv: list[str] | None = None) -> int:
        raise ModuleNotFoundError("No module named 'rerun.blueprint'", name="rerun.blueprint")

    assert main() == REFUSED
    assert capsys.readouterr().err == ("pp-x: rerun is not installed: pip install 'ponderpounce-server[replay]'\n")


def test_a_module_of_ours_that_is_missing_is_a_defect() -> None:
    @command("pp-x")
    def main(argv: list[str] | None = None) -> int:
        raise ModuleNotFoundError("No module named 'clock.nonsense'", name="clock.nonsense")

    with pytest.raises(ModuleNotFoundError):
        main()


LIGHT = {
    "mujoco tqdm torch tokenizers robosuite rerun zmq av pyarrow": ("sim_client.gateway.__main__",),
    "mujoco tqdm torch tokenizers transformers websockets msgpack rerun": (
        "ponder_server.__main__",
        "ponder_server.chat.build",
        "pounce_server.__main__",
        "sim_client.watch.__main__",
        "clock.check",
    ),
    "mujoco torch transformers": ("dual_system.models.ponder.configs",),
}
"""Heavy packages, and what starts without them."""


@pytest.mark.parametrize(("without", "modules"), LIGHT.items(), ids=["pp-gateway", "the others", "PONDER's sizes"])
def test_a_light_command_starts_without_heavy_packages(without: str, modules: tuple[str, ...]) -> None:
    blocked = "import sys; sys.modules.update(dict.fromkeys(sys.argv[1].split())); [*map(__import__, sys.argv[2:])]"
    assert all(importlib.util.find_spec(module) is not None for module in modules)
    subprocess.run([sys.executable, "-c", blocked, without, *modules], check=True, timeout=60)
