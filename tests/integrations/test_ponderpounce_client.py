"""The client's distribution: it stands alone, in the Python that robots' computers have."""

from __future__ import annotations

import ast
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ponderpounce_client import watchdog
from ponderpounce_client.client import _picture
from ponderpounce_client.watchdog import Watchdog

from protocol.images import jpeg

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "integrations" / "ponderpounce_client" / "ponderpounce_client").glob("*.py"))
ALLOWED = {"ponderpounce_client", "numpy", "msgpack", "websockets", "cv2"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_its_files_are_python_3_8_and_import_nothing_of_ours(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 8))
    named = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    named |= {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    ours = {path.name for path in ROOT.iterdir() if (path / "__init__.py").is_file()}
    assert not {name.partition(".")[0] for name in named} & (ours - ALLOWED)


def test_a_jpeg_travels_with_the_size_that_it_has() -> None:
    told = _picture(jpeg(np.zeros((6, 9, 3), np.uint8)), "front")
    assert told["shape"] == [6, 9, 3]


@pytest.mark.parametrize("image", [b"", b"\xff\xd8", b"\xff\xd8\xff", b"PNG" * 9, np.zeros((4, 4)), [[0]], None])
def test_what_is_no_picture_is_told_by_its_camera(image: object) -> None:
    with pytest.raises(ValueError, match="front: expected"):
        _picture(image, "front")


def test_a_watchdog_fires_once_it_is_armed_and_not_before(tmp_path: Path) -> None:
    stopped = tmp_path / "robot"
    watchdog = Watchdog(Path.touch, stopped)
    watchdog.feed(time.monotonic_ns() + 3_600_000_000_000)
    watchdog.rest()
    assert not stopped.exists()
    watchdog.feed(0)
    until_s = time.monotonic() + 20
    while not watchdog.has_fired:
        assert time.monotonic() < until_s
        time.sleep(0.01)  # another process
    assert stopped.exists()
    watchdog.close()


class Deadly:
    """Whoever reads it from another process dies."""

    def __reduce__(self) -> tuple[Any, tuple[int]]:
        return os._exit, (3,)


def test_a_watchdog_that_dies_at_its_start_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watchdog, "_START_S", float("inf"))
    with pytest.raises(RuntimeError, match="did not start"):
        Watchdog(print, Deadly())


def test_a_program_that_closes_an_armed_watchdog_leaves_a_stopped_robot(tmp_path: Path) -> None:
    """The gateway's end is heard before its last command expires."""
    stopped = tmp_path / "robot"
    watchdog = Watchdog(Path.touch, stopped)
    watchdog.feed(time.monotonic_ns() + 200_000_000)
    watchdog.close()
    assert stopped.exists()
