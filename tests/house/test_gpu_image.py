"""What a borrowed GPU's image has: torch, transformers, pytest; no packages of robot, simulator and bus."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.gpu_stages import GPU_TESTS

LACKING = ("tyro", "zenoh", "simplejpeg", "mcap", "av", "mujoco")
NEED_THEM = (
    "__main__", "config", "fleet", "in_process", "history", "node", "past", "serve", "parity", "export_hf",
    "import_folder", "inspect_folder",
)  # fmt: skip
"""Command lines and daemons: the last part of their modules' names."""
NETWORKED = ("ponder_server.chat", "pounce_server.remote")
"""Rooms that ask other programs, and need no GPU."""
SCRIPT = f"""
import importlib, importlib.util, pkgutil, sys
from pathlib import Path
for name in {LACKING}:
    sys.modules[name] = None
import benchmarks.gpu_day, dual_system.models, ponder_server, pounce_server
for room in (dual_system.models, ponder_server, pounce_server):
    for module in pkgutil.walk_packages(room.__path__, room.__name__ + "."):
        if module.name.rsplit(".", 1)[-1] not in {NEED_THEM} and not module.name.startswith({NETWORKED}):
            importlib.import_module(module.name)
for path in Path("tests").rglob("test_*.py"):
    if "@pytest.mark.gpu\\n" in path.read_text() and path.parent.name != "house":
        spec = importlib.util.spec_from_file_location(path.stem, path)
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
        print(path.stem)
"""


def test_the_gpu_path_imports_without_the_robot_s_packages(pytestconfig: pytest.Config) -> None:
    """Also the files whose tests run on a GPU: there with --noconftest."""
    command, root = [sys.executable, "-c", SCRIPT], pytestconfig.rootpath
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False, timeout=90)
    assert done.returncode == 0, done.stderr[-1500:]
    assert sorted(done.stdout.split()) == sorted(Path(path).stem for path in GPU_TESTS), "gpu_day runs all of them"
