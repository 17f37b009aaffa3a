"""Test scenes wait for a commit that names the weights they are played with."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from benchmarks.policy_weights import WEIGHTS, UncommittedError, require_committed


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    root = tmp_path / "repository"
    (root / WEIGHTS).parent.mkdir(parents=True)
    git(root, "init", "-q")
    git(root, "commit", "-q", "--allow-empty", "-m", "first")
    return root


def git(root: Path, *arguments: str) -> None:
    who = ("-c", "user.name=x", "-c", "user.email=x@example.org")
    subprocess.run(["git", *who, *arguments], cwd=root, check=True)


def commit(root: Path) -> None:
    git(root, "add", WEIGHTS.as_posix())
    git(root, "commit", "-q", "-m", "weights")


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    (tmp_path / "row").mkdir()
    (tmp_path / "row" / "model.safetensors").write_bytes(b"trained")
    return tmp_path / "row"


def test_weights_are_named_by_a_commit_first_and_by_no_other_later(repository: Path, weights: Path) -> None:
    for _ in range(2):  # written is not committed
        with pytest.raises(UncommittedError, match="commit benchmarks"):
            require_committed([weights], weights.parent, repository)
    commit(repository)
    require_committed([weights], weights.parent, repository)
    (weights / "model.safetensors").write_bytes(b"trained since")
    committed = (repository / WEIGHTS).read_text()
    with pytest.raises(UncommittedError, match="another experiment"):
        require_committed([weights], weights.parent, repository)
    assert (repository / WEIGHTS).read_text() == committed


def test_state_of_training_is_no_weight(repository: Path, weights: Path) -> None:
    (weights / "checkpoint").mkdir()
    (weights / "checkpoint" / "weights.safetensors").write_bytes(b"on the way")
    with pytest.raises(UncommittedError):
        require_committed([weights], weights.parent, repository)
    assert list((repository / WEIGHTS).read_text().split('"')[1::4]) == ["row/model.safetensors"]
