"""Weights are named in a commit before the first test scene is played with them: nothing is chosen on test scenes."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

from protocol.errors import CommandError

_ROOT = Path(__file__).parents[1]
WEIGHTS = Path("benchmarks/reports/laptop_weights.json")


class UncommittedError(CommandError):
    """Test scenes are to be played with weights that no commit names."""


def require_committed(
    checkpoints: Sequence[Path], folder: Path, root: Path = _ROOT, *, weights: Path = WEIGHTS
) -> None:
    """Writes the hashes of the checkpoints' weights into the repository, and requires that its newest commit has them.

    ``weights``: the file, in the repository.

    Raises UncommittedError if it has not, or has others.
    """
    found = json.dumps(_hashes(checkpoints, folder), indent=2) + "\n"
    committed = subprocess.run(["git", "show", f"HEAD:{weights.as_posix()}"], cwd=root, capture_output=True, text=True)
    if committed.returncode == 0 and committed.stdout == found:
        return
    if committed.returncode == 0:
        raise UncommittedError(
            f"the newest commit's {weights} names other weights than {folder} holds. Test scenes are played once: "
            "weights that were trained since are another experiment, with another range of scenes"
        )
    (root / weights).write_text(found, encoding="utf-8")
    raise UncommittedError(f"commit {weights}, which has just been written, and run this again: test scenes come next")


def _hashes(checkpoints: Sequence[Path], folder: Path) -> dict[str, str]:
    files = sorted(
        file for each in checkpoints for file in each.rglob("*.safetensors") if "checkpoint" not in file.parts
    )
    return {file.relative_to(folder).as_posix(): sha256(file.read_bytes()).hexdigest() for file in files}
