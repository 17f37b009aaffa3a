"""Shared fixtures: where the repository is, and which of its files are ours."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def root() -> Path:
    return ROOT


@pytest.fixture(scope="session")
def files(root: Path) -> tuple[str, ...]:
    """Every file of the working tree that git tracks or would track, as paths relative to the root."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout.split("\0")
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("needs a git checkout: which files are ours is git's knowledge")
    return tuple(sorted(name for name in listed if name and (root / name).is_file()))


@pytest.fixture(scope="session")
def written(files: tuple[str, ...]) -> tuple[str, ...]:
    """The Python files that a person wrote."""
    return tuple(name for name in files if name.endswith(".py") and not name.endswith("_pb2.py"))
